"""Fuzz bags and messages with coverage guidance, by Atheris.

    pip install atheris
    python test/faults/fuzz.py message --seconds 600

Inputs that reach new lines are kept in ``build/fuzz/TARGET`` and begun with the next time; what fails is left
there as ``crash-…``, ``timeout-…`` or ``oom-…``. Copied to ``test/faults/corpus/TARGET`` it is a test: the
bounded form, `test_fuzz.py`, needs no Atheris.
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
MOST_CHARACTERS = 600
#: An input may take so long (s), and the process so much memory (MB).
MOST_SECONDS, MOST_MB = 10, 1000

#: What reads an input: it returns, or raises what must not be.
Target = Callable[[bytes], None]


def packed(kind: int, cdrs: list[bytes]) -> bytes:
    """Return an input of the target "message": its kind, and each message behind its length."""
    return bytes([kind]) + b"".join(struct.pack("<I", len(cdr)) + cdr for cdr in cdrs)


def unpacked(data: bytes, count: int) -> list[bytes]:
    """Return so many messages, of whatever an input holds."""
    found, at = [], 1
    for n in range(count):
        length = int.from_bytes(data[at : at + 4], "little")
        end = len(data) if n == count - 1 else at + 4 + length
        found.append(data[at + 4 : end])
        at = end
    return found


def _accepted(read: Callable[[], object]) -> None:
    """Read something: it is read, or refused in one line."""
    from csas_shadow_ros.core.errors import CsasError

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy's would go to a node's standard error
        try:
            read()
        except CsasError as error:
            text = str(error)
            if "\n" in text or len(text) > MOST_CHARACTERS:
                raise AssertionError(f"refused in {text[:1000]!r}") from error


def targets(folder: Path) -> dict[str, tuple[Target, list[bytes]]]:
    """Return, by name, what reads an input, and sound inputs to begin with.

    Parameters
    ----------
    folder : path
        Where bags are written.
    """
    import damage
    import test_bad_messages

    import msg_adapters
    from msg_adapters.messages import typestore

    samples = list(test_bad_messages.samples().values())
    store = typestore()

    def message(data: bytes) -> None:
        messages, read = samples[data[0] % len(samples) if data else 0]
        cdrs = unpacked(data, len(messages))
        _accepted(
            lambda: read(
                *(
                    msg_adapters.message_from_cdr(cdr, one.__msgtype__, "input")
                    for cdr, one in zip(cdrs, messages, strict=True)
                )
            )
        )

    sound = [
        packed(n, [bytes(store.serialize_cdr(one, one.__msgtype__)) for one in messages])
        for n, (messages, _) in enumerate(samples)
    ]
    made: dict[str, tuple[Target, list[bytes]]] = {"message": (message, sound)}
    run = damage.run_messages()[:7]
    seeds: dict[str, list[bytes]] = {"mcap": [], "db3": [], "yaml": []}
    for n, make in enumerate(damage.KINDS.values()):
        make(folder / f"sound_{n}", run)
        for file in sorted((folder / f"sound_{n}").iterdir()):
            seeds.get(file.suffix[1:], []).append(file.read_bytes())
    whole = folder / "sound_0"

    def bag(ending: str) -> Target:
        path = folder / f"input_{ending}"
        path.mkdir()

        def read(data: bytes) -> None:
            if ending == "yaml":  # beside the file that it should describe
                for file in whole.glob("*.mcap"):
                    (path / file.name).write_bytes(file.read_bytes())
                (path / "metadata.yaml").write_bytes(data)
                _accepted(lambda: damage.read(path))
            else:
                (path / f"input.{ending}").write_bytes(data)
                _accepted(lambda: damage.read(path / f"input.{ending}"))

        return read

    return made | {ending: (bag(ending), found) for ending, found in seeds.items()}


def main() -> None:
    """Fuzz one target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("target", choices=("message", "mcap", "db3", "yaml"))
    parser.add_argument("--seconds", type=int, default=600, metavar="S", help="fuzz for S s (default 600)")
    given = parser.parse_args()
    import atheris

    sys.path.insert(0, str(HERE.parents[1]))
    kept = Path("build/fuzz") / given.target
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        with atheris.instrument_imports(include=["csas_shadow_ros", "msg_adapters"]):
            read, sound = targets(Path(folder))[given.target]
        for n, data in enumerate(sound):
            (kept / f"sound_{n}").write_bytes(data)
        again = [str(path) for path in (CORPUS / given.target,) if path.is_dir()]
        flags = [
            f"-max_total_time={given.seconds}",
            f"-timeout={MOST_SECONDS}",
            f"-rss_limit_mb={MOST_MB}",
            f"-artifact_prefix={kept}/",
            f"-max_len={max(map(len, sound))}",
            "-print_final_stats=1",
        ]
        atheris.Setup([sys.argv[0], *flags, str(kept), *again], read)
        atheris.Fuzz()


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
