"""Replays and live graphs under kills, stops, full disks and little of everything: seeded, resumable.

``python test/faults/soak.py --trials 200 --out FOLDER`` appends a line of JSON a trial to
``FOLDER/trials.jsonl`` and says at the end what it found; started again it goes on. ``--seed N --trials 1``
is one trial of it. Other modes: ``--circles N`` (in one live graph, with kills in each), ``--soak SECONDS``
(circle after circle in one live graph, with the memory of every process), ``--same-draw ROUNDS`` (four
replays at once that draw the same random numbers), ``--two-graphs CIRCLES`` (one domain, two namespaces),
``--report`` (what the lines say). ``docs/reliability.md`` has figures.

A trial names in ``faults`` what must not be; a sound one names nothing. Every process of a trial is known by
an environment variable that its descendants inherit, and none but those is ever signalled.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MARK = "CSAS_SOAK_TRIAL"
#: 36 views and few voxels: the same code as for a large run, in seconds.
STEP_DEG, VOXEL_M = 10.0, 0.05
OPTIONS = [f"--step-deg={STEP_DEG:g}", f"--voxel-size-m={VOXEL_M:g}", "--no-figures", "--no-sync", "-q"]
#: A replay gives up after 180 s without any news, a killed sink is waited for 60 s.
HUNG_S = 300.0
#: Processes and shared memory may outlive a killed launching process for so long.
LEFT_S = 10.0
#: Each node may be killed so often before the replay gives up by design.
KILLS_A_NODE = 3
#: Recorder, player, stages and sinks.
NODES = ("bag_player", "sub_aperture", "shadow_enhancement", "shadow_likelihood", "voxel_carver")
#: What a trial is, in turn; those that kill in the middle of a run are most of them.
KINDS = (
    *("image", "launcher", "sector", "shadow", "live", "two folders", "image", "shadow_mask"),
    *("launcher", "clock", "sector", "live", "full disk", "image", "shadow", "one folder"),
    *("few files", "sector", "launcher", "read-only", "image", "live", "shadow_mask", "little memory"),
)
#: Kinds in which a refusal in one line is a good answer.
MAY_FAIL = ("full disk", "few files", "little memory", "read-only", "one folder")
STREAMS = ("sub_aperture", "shadow", "likelihood", "shadow_mask")


# Bags and what they must leave


def hash_of(*arrays: Any) -> str:
    """Return a hash of arrays' shapes, types and bytes."""
    digest = hashlib.sha256()
    for array in arrays:
        data = np.ascontiguousarray(array)
        digest.update(f"{data.shape}{data.dtype}".encode() + data.tobytes())
    return digest.hexdigest()[:16]


def grid_hash(folder: Path) -> str:
    """Return the hash of a results folder's grid; "none" where there is none."""
    file = folder / "grid.npz"
    if not file.exists():
        return "none"
    with np.load(file) as grid:
        return hash_of(*(grid[name] for name in ("likelihood", "occupied", "views", "origin_m", "threshold")))


class Bags:
    """The runs that are replayed, and the hashes of their undisturbed grids."""

    SCENES = ("box", "cone", "l_shape", "cylinder")

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "expected.json"
        self.expected: dict[str, Any] = json.loads(self.file.read_text()) if self.file.exists() else {}

    def path(self, name: str) -> Path:
        """Return a bag, made if it is not there."""
        path = self.folder / name
        if name.endswith("views"):  # everything that a run publishes: any stage can be started from
            return self._result(name.removesuffix("_views")) / "result.mcap"
        if not path.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            scene, _, sectors = name.partition("_sectors")
            more = ["--sectors", "30"] if name.endswith("_sectors") else []
            _ = sectors
            csas("simulate", path, "--profile", "tiny", "--target", scene, "--seed", "3", *more)
        return path

    def _result(self, name: str) -> Path:
        folder = self.folder / f"{name}_result"
        if not (folder / "result.mcap").exists():
            csas("run", self.path(name), "--out", folder, "--overwrite", *OPTIONS)
        return folder

    def hash_of(self, name: str, start: str = "auto") -> str:
        """Return the hash of the grid that a bag leaves in one undisturbed process."""
        key = f"{name} {start}"
        if key not in self.expected:
            folder = self.folder / "undisturbed"
            more = ["--start-from", start, "--no-bag", "--overwrite"]
            csas("run", self.path(name), "--out", folder, *OPTIONS, *more)
            self._note(key, grid_hash(folder))
            with np.load(folder / "grid.npz") as grid:
                self._note(f"{key} likelihood", hash_of(grid["likelihood"]))
        return str(self.expected[key])

    def live_hash(self, name: str) -> str:
        """Return the hash of the likelihood alone, which a live graph publishes."""
        self.hash_of(name)
        return str(self.expected[f"{name} auto likelihood"])

    def seconds(self, name: str, start: str = "auto") -> float:
        """Return how long an undisturbed replay takes here."""
        key = f"{name} {start} seconds"
        if key not in self.expected:
            began = time.monotonic()
            folder = self.folder / "undisturbed"
            more = ["--start-from", start, "--overwrite"]
            csas("replay", self.path(name), "--out", folder, *OPTIONS, *more)
            self._note(key, round(time.monotonic() - began, 2))
        return float(self.expected[key])

    def _note(self, key: str, value: Any) -> None:
        self.expected[key] = value
        self.file.write_text(json.dumps(self.expected, indent=1))


def environment(mark: str = "") -> dict[str, str]:
    """Return the environment of a trial's processes."""
    own = {"PYTHONPATH": str(ROOT), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own} | ({MARK: mark} if mark else {})


def csas(*arguments: object) -> None:
    """Run a command that nothing disturbs."""
    command = [sys.executable, "-m", "csas_shadow_ros.cli", *map(str, arguments)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr}")


# Processes


def marked(mark: str) -> list[int]:
    """Return the live processes of a trial, zombies not counted."""
    wanted = f"{MARK}={mark}\0".encode()
    found = []
    for entry in os.listdir("/proc"):
        with contextlib.suppress(OSError):
            if entry.isdigit() and wanted in Path(f"/proc/{entry}/environ").read_bytes():
                found.append(int(entry))
    return found


def name_of(pid: int) -> str:
    """Return which node a process is: they write into logs of their names."""
    with contextlib.suppress(OSError):
        log = Path(os.readlink(f"/proc/{pid}/fd/1"))
        if log.suffix == ".log":
            return log.stem
    return ""


def children_of(pid: int) -> list[int]:
    """Return a process' children."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for task in os.listdir(f"/proc/{pid}/task"):
            found += map(int, Path(f"/proc/{pid}/task/{task}/children").read_text().split())
    return found


class Command:
    """A `csas-shadow` command whose processes are watched, killed and stopped.

    Parameters
    ----------
    mark : str
        What its processes' environment names them by.
    arguments : list of str
        Of the command.
    log : Path
        Where its standard error goes.
    before : str
        Python that runs before it.
    limits : sequence of (resource, bytes or number)
        Of the launching process and all that it starts.
    """

    def __init__(
        self,
        mark: str,
        arguments: list[str],
        log: Path,
        before: str = "",
        limits: tuple[tuple[int, int], ...] = (),
    ) -> None:
        self.mark, self.log = mark, log
        #: Shared memory, and whose it was first.
        self.seen: dict[Path, str] = {}

        def confine() -> None:
            for kind, limit in limits:
                resource.setrlimit(kind, (limit, limit))

        code = f"{before}\nfrom csas_shadow_ros.cli import run_and_exit\nrun_and_exit()"
        with log.open("ab") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code, *arguments],
                env=environment(mark),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
                preexec_fn=confine if limits else None,
            )

    def nodes(self) -> dict[int, str]:
        """Return the processes that it has started, by name; notes what shared memory they have."""
        from csas_shadow_ros.nodes.runtime.shared_memory import segments_of

        found = {pid: name_of(pid) for pid in children_of(self.process.pid)}
        for pid in (self.process.pid, *found):
            for segment in segments_of(pid):
                self.seen.setdefault(segment, found.get(pid) or str(pid))
        return {pid: name for pid, name in found.items() if name}

    def said(self) -> str:
        """Return the last line that it wrote."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1][:300] if lines else ""

    def traceback(self) -> bool:
        """Say whether a user saw a traceback."""
        return "Traceback (most recent call last)" in self.log.read_text(errors="replace")

    def whose(self, segments: list[Path]) -> str:
        """Say whose some segments were."""
        return ", ".join(f"{segment.name} of {self.seen[segment]}" for segment in segments)

    def left(self, patience_s: float = LEFT_S) -> list[str]:
        """Return the processes and the shared memory that are left after a while."""
        end = time.monotonic() + patience_s
        while True:
            pids = marked(self.mark)
            segments = [s for s in self.seen if s.exists()]
            if not (pids or segments) or time.monotonic() > end:
                break
            time.sleep(0.1)
        found = [f"process {name_of(pid) or pid} is left" for pid in pids]
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return found + ([f"shared memory is left: {self.whose(segments)}"] if segments else [])


class Havoc:
    """Kills and stops of a trial's processes at times drawn before it begins.

    Parameters
    ----------
    rng : random.Random
        What draws.
    span_s : float
        An undisturbed run's time.
    kills, stops : int
        How many of each.
    """

    def __init__(self, rng: random.Random, span_s: float, kills: int, stops: int = 0) -> None:
        self.rng = rng
        whats = ["kill"] * kills + ["stop"] * stops
        self.plan = sorted((rng.uniform(0.1, 0.9) * span_s, what) for what in whats)
        self.began_s = time.monotonic()
        self.kills: list[tuple[float, str]] = []
        self.stops: list[tuple[float, str, float]] = []
        self._stopped: list[tuple[float, int]] = []
        self._killed: collections.Counter[str] = collections.Counter()
        self._waits: dict[str, float] = {}
        #: Seconds from a kill to the successor's first sign.
        self.recovered_s: list[float] = []

    def step(self, nodes: dict[int, str], launcher: int | None = None) -> None:
        """Do what is due to the processes that are there now."""
        now = time.monotonic()
        for name, since in list(self._waits.items()):
            if name in nodes.values():
                self.recovered_s.append(round(now - since, 3))
                del self._waits[name]
        while self.plan and now - self.began_s >= self.plan[0][0]:
            _, what = self.plan.pop(0)
            able = {pid: name for pid, name in nodes.items() if self._killed[name] < KILLS_A_NODE}
            if what == "stop" and launcher is not None and self.rng.random() < 0.2:
                self._stop(launcher, "launcher")
            elif able:
                pid = self.rng.choice(sorted(able))
                name = nodes.pop(pid)
                if what == "stop":
                    self._stop(pid, name)
                    continue
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    self._killed[name] += 1
                    self.kills.append((round(now - self.began_s, 2), name))
                    if name != "fork_server":
                        self._waits[name] = now
        self.go_on()

    def _stop(self, pid: int, name: str) -> None:
        # Shorter and longer than the 3 s after which a consumer counts as gone.
        seconds = self.rng.choice((0.2, 1.0, 4.0, 7.0))
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            self._stopped.append((time.monotonic() + seconds, pid))
            self.stops.append((round(time.monotonic() - self.began_s, 2), name, seconds))

    def go_on(self, *, at_once: bool = False) -> None:
        """Let those go on whose time is over."""
        for when, pid in list(self._stopped):
            if at_once or time.monotonic() >= when:
                self._stopped.remove((when, pid))
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)


def watch(command: Command, havoc: Havoc | None, faults: list[str], limit_s: float = HUNG_S) -> float:
    """Run a command to its end under havoc; return its wall time."""
    began = time.monotonic()
    while command.process.poll() is None:
        if time.monotonic() - began > limit_s:
            faults.append(f"hung: not at its end after {limit_s:g} s")
            faults[-1] += f"; {', '.join(name_of(p) or str(p) for p in marked(command.mark))} are there"
            break
        nodes = command.nodes()
        if havoc is not None:
            havoc.step(nodes, command.process.pid)
        time.sleep(0.03)
    if havoc is not None:
        havoc.go_on(at_once=True)
    if command.process.poll() is None:
        command.process.kill()
    command.process.wait()
    return time.monotonic() - began


# Trials


class Trial:
    """One trial: what is done, and what came of it.

    Parameters
    ----------
    seed : int
        Draws everything.
    bags : Bags
        Runs.
    folder : Path
        Its own.
    kind : str, optional
        One of `KINDS`; that of the seed otherwise.
    """

    def __init__(self, seed: int, bags: Bags, folder: Path, kind: str | None = None) -> None:
        self.kind = kind or KINDS[seed % len(KINDS)]
        self.rng = random.Random(f"{self.kind} {seed}")
        self.bags, self.folder = bags, folder
        self.mark = f"{os.getpid()}-{seed}"
        self.out = folder / "out"
        self.faults: list[str] = []
        self.line: dict[str, Any] = {"seed": seed, "kind": self.kind, "kills": [], "stops": [], "lost": 0}

    def go(self) -> dict[str, Any]:
        """Do it; return its line."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        began = time.monotonic()
        work = {
            "launcher": self.launcher_killed,
            "live": self.live,
            "two folders": self.two_folders,
            "one folder": self.one_folder,
            "full disk": self.full_disk,
            "read-only": self.read_only,
            "few files": lambda: self.confined(resource.RLIMIT_NOFILE, self.rng.randint(16, 160)),
            "little memory": lambda: self.confined(resource.RLIMIT_AS, self.rng.randint(200, 4000) << 20),
            "clock": self.clock_jumps,
        }.get(self.kind, self.replayed)
        work()
        self.line |= {"wall_s": round(time.monotonic() - began, 1), "faults": self.faults}
        if not self.faults:
            shutil.rmtree(self.folder, ignore_errors=True)
        return self.line

    # Pieces

    def choose(self) -> tuple[str, str]:
        """Draw a scene; return the bag and where it starts."""
        scene = self.rng.choice(Bags.SCENES[:2])
        if self.kind == "sector":
            return f"{scene}_sectors", "auto"
        if self.kind in ("shadow", "shadow_mask"):
            return f"{scene}_views", self.kind
        if self.kind == "clock":
            return f"{scene}_views", "shadow"
        return scene, "auto"

    def command(self, bag: Path, out: Path, *more: str, start: str = "auto", **options: Any) -> Command:
        """Start a replay."""
        log = self.folder / f"{out.name}.said"
        arguments = ["replay", str(bag), "--out", str(out), "--start-from", start, *OPTIONS, *more]
        return Command(self.mark, arguments, log, **options)

    def judge(self, command: Command, out: Path, expected: str, *, may_fail: bool | None = None) -> None:
        """Hold what a command left against what it must leave."""
        may_fail = self.kind in MAY_FAIL if may_fail is None else may_fail
        code = command.process.returncode
        self.line.setdefault("exits", []).append(code)
        if command.traceback():
            self.faults.append(f"a traceback: {command.said()}")
        if code != 0 and not may_fail:
            self.faults.append(f"exit status {code}: {command.said()}")
        if code != 0:
            self.line.setdefault("said", []).append(command.said())
            if not command.said():
                self.faults.append(f"exit status {code} without a word")
            if code < 0:
                self.faults.append(f"the launching process died of signal {-code}")
        found = grid_hash(out)
        if code == 0 and found == "none":
            self.faults.append("exit status 0 without a grid")
        if found not in ("none", expected):
            self.faults.append(f"the grid differs: {found}, expected {expected}")
        self.line.setdefault("grids", []).append("right" if found == expected else found)
        if found != "none":
            self.check(out)
            views = json.loads((out / "report.json").read_text())["views"]
            self.line["lost"] += views["lost"]
            if views["lost"] or (views["in"], views["used"]) != (36, 36):
                self.faults.append(f"views: {views}")

    def check(self, out: Path) -> None:
        """Hold a results folder against its own list of files."""
        command = [sys.executable, "-m", "csas_shadow_ros.cli", "check", str(out)]
        done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
        if done.returncode:
            told = f"{done.stdout.strip()[-200:]} {done.stderr.strip()[-200:]}"
            self.faults.append(f"check of {out.name}: {told}")

    def take(self, havoc: Havoc, wall_s: float, undisturbed_s: float) -> None:
        """Note what was done."""
        self.line["kills"] += havoc.kills
        self.line["stops"] += havoc.stops
        self.line.setdefault("recovered_s", []).extend(havoc.recovered_s)
        self.line.setdefault("extra_s", []).append(round(wall_s - undisturbed_s, 1))

    # Kinds

    def replayed(self) -> None:
        """Kill and stop nodes, recorder, player and fork server of a replay."""
        name, start = self.choose()
        expected, span = self.bags.hash_of(name, start), self.bags.seconds(name, start)
        havoc = Havoc(self.rng, span, self.rng.randint(2, 9), self.rng.choice((0, 0, 1, 2)))
        command = self.command(self.bags.path(name), self.out, start=start)
        wall = watch(command, havoc, self.faults)
        self.take(havoc, wall, span)
        self.judge(command, self.out, expected)
        self.faults += command.left()

    def launcher_killed(self) -> None:
        """Kill the launching process itself, and nodes before it; then the same command must succeed."""
        name, start = self.choose()
        expected, span = self.bags.hash_of(name, start), self.bags.seconds(name, start)
        old = self.rng.random() < 0.5
        if old:  # a sound result of another bag, which is to be replaced
            shutil.copytree(self.bags._result("l_shape"), self.out)
        havoc = Havoc(self.rng, span, self.rng.randint(0, 2))
        command = self.command(self.bags.path(name), self.out, "--overwrite", start=start)
        ends_s = time.monotonic() + self.rng.uniform(0.05, 1.1) * span
        while command.process.poll() is None and time.monotonic() < ends_s:
            havoc.step(command.nodes(), None)
            time.sleep(0.02)
        killed = command.process.poll() is None
        if killed:
            command.nodes()
            command.process.kill()
            havoc.kills.append((round(time.monotonic() - havoc.began_s, 2), "launcher"))
        command.process.wait()
        self.faults += command.left()
        before = self.bags.hash_of("l_shape") if old else "none"
        found = grid_hash(self.out)
        if found not in (before, expected):
            self.faults.append(f"after the kill {found} is in place; expected {before} or {expected}")
        if self.out.exists():
            self.check(self.out)
        again = self.command(self.bags.path(name), self.out, "--overwrite", start=start)
        wall = watch(again, None, self.faults)
        self.take(havoc, wall, span)
        self.judge(again, self.out, expected)
        self.faults += again.left()
        if hidden := [p.name for p in self.folder.glob(".*")]:
            self.faults.append(f"left behind: {', '.join(hidden)}")

    def two_folders(self) -> None:
        """Two replays at once, each of its own bag into its own folder, under kills."""
        commands = []
        for scene in ("box", "cone"):
            expected, span = self.bags.hash_of(scene), self.bags.seconds(scene)
            out = self.folder / scene
            havoc = Havoc(self.rng, 1.5 * span, self.rng.randint(0, 3))
            commands.append((self.command(self.bags.path(scene), out), havoc, out, expected, span))
        began = time.monotonic()
        while any(c.process.poll() is None for c, *_ in commands) and time.monotonic() - began < HUNG_S:
            for command, havoc, *_ in commands:
                if command.process.poll() is None:
                    havoc.step(command.nodes(), None)
            time.sleep(0.03)
        for command, havoc, out, expected, span in commands:
            watch(command, None, self.faults, 0.1)
            self.take(havoc, time.monotonic() - began, span)
            self.judge(command, out, expected)
        self.faults += [line for command, *_ in commands for line in command.left()]

    def one_folder(self) -> None:
        """Two replays at once into one folder: what is in place at the end is whole, and one of them."""
        more = ["--overwrite"] if self.rng.random() < 0.5 else []
        hashes = {scene: self.bags.hash_of(scene) for scene in ("box", "cone")}
        commands = []
        for scene in hashes:
            commands.append(self.command(self.bags.path(scene), self.out, *more))
            time.sleep(self.rng.uniform(0.0, 2.0))
        for command in commands:
            watch(command, None, self.faults)
        found = grid_hash(self.out)
        if found not in hashes.values():
            self.faults.append(f"{found} is in place; expected one of {hashes}")
        for command in commands:
            self.judge(command, self.out, found)
        if 0 not in self.line["exits"] or (more and self.line["exits"] != [0, 0]):
            self.faults.append(f"exits {self.line['exits']}: {self.line.get('said')}")
        self.faults += [line for command in commands for line in command.left()]

    def full_disk(self) -> None:
        """Replay onto a disk that fills in the middle of it."""
        megabytes = self.rng.randint(1, 60)
        self.line["disk_mb"] = megabytes
        expected, span = self.bags.hash_of("box"), self.bags.seconds("box")
        with small_disk(self.folder / "disk", megabytes) as disk:
            limits: tuple[tuple[int, int], ...] = ()
            out = (disk or self.folder) / "out"
            command = self.command(self.bags.path("box"), out, limits=limits)
            if disk is None:
                self.line["stand_in"] = "RLIMIT_FSIZE"
                self.forbid_growth(command, megabytes << 18)
            havoc = Havoc(self.rng, span, self.rng.choice((0, 0, 1)))
            wall = watch(command, havoc, self.faults)
            self.take(havoc, wall, span)
            self.judge(command, out, expected)
            self.faults += command.left()

    def forbid_growth(self, command: Command, size: int) -> None:
        """Let no file of the recorder's grow further, as soon as there is one."""
        while command.process.poll() is None:
            for pid, name in command.nodes().items():
                if name == "bag_recorder":
                    with contextlib.suppress(ProcessLookupError):
                        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, size))
                    return
            time.sleep(0.02)

    def read_only(self) -> None:
        """Replay into a folder that cannot be written to."""
        with small_disk(self.folder / "disk", 4, "ro") as disk:
            out = (disk or Path("/sys")) / "out"  # which even root cannot write to
            command = self.command(self.bags.path("box"), out)
            watch(command, None, self.faults)
            self.judge(command, out, "none")
            if command.process.returncode == 0:
                self.faults.append("exit status 0 in a read-only folder")
            self.faults += command.left()

    def confined(self, kind: int, limit: int) -> None:
        """Replay with few file handles, or little memory."""
        self.line["limit"] = limit
        expected = self.bags.hash_of("box")
        command = self.command(self.bags.path("box"), self.out, limits=((kind, limit),))
        watch(command, None, self.faults)
        self.judge(command, self.out, expected)
        self.faults += command.left()

    def clock_jumps(self) -> None:
        """Replay views at a rate whose recorder's clock jumped."""
        name, start = self.choose()
        bag = self.folder / "jumps"
        jumping(self.bags.path(name), bag, self.rng)
        expected = self.bags.hash_of(name, start)
        command = self.command(bag, self.out, "--rate", "100", start=start)
        havoc = Havoc(self.rng, self.bags.seconds(name, start), self.rng.randint(0, 2))
        wall = watch(command, havoc, self.faults)
        self.take(havoc, wall, self.bags.seconds(name, start))
        self.judge(command, self.out, expected)
        self.faults += command.left()

    def live(self) -> None:
        """Two runs after one another through one live graph, under kills."""
        told = live_child(self.mark, self.bags, self.folder, self.rng.getrandbits(32), "--circles", "2")
        self.line["kills"] += told.pop("kills")
        self.faults += told.pop("faults")
        self.line |= told


def jumping(source: Path, bag: Path, rng: random.Random) -> None:
    """Copy a bag as a recorder writes it whose clock is set back and forth: a second a view, and jumps."""
    from csas_shadow_ros.bags import BagReader, BagWriter

    when = 10**18
    with BagWriter(bag) as writer:
        for message in BagReader(source).messages():
            if message.topic.endswith("shadow/image"):
                when += 10**9
                if rng.random() < 0.15:
                    when += int(rng.choice((-7200.0, -3.0, 120.0, 7200.0, 1e6)) * 1e9)
            writer.write(message.topic, message.cdr, when, type_name=message.type_name)


@contextlib.contextmanager
def small_disk(path: Path, megabytes: int, how: str = "rw") -> Iterator[Path | None]:
    """Mount a file system of its own; None where this user may not."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"{how},size={megabytes}m", "tmpfs", str(path)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        yield None
        return
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def live_child(mark: str, bags: Bags, folder: Path, seed: int, *more: str) -> dict[str, Any]:
    """Run a live graph in a process of its own (`live.py`); return what it tells."""
    for scene in Bags.SCENES[:3]:
        bags.live_hash(scene)
    command = [sys.executable, str(Path(__file__).with_name("live.py")), str(bags.folder), str(folder)]
    with (folder / "live.said").open("ab") as log:
        child = subprocess.Popen(
            [*command, "--seed", str(seed), *more],
            env=environment(mark),
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    # The middleware writes lines of its own there.
    lines = [json.loads(line) for line in child.stdout or () if line.startswith("{")]
    child.wait()
    left = [f"process {name_of(pid) or pid} is left" for pid in marked(mark)]
    if not lines or child.returncode:
        said = (folder / "live.said").read_text()[-600:]
        return {"kills": [], "faults": [f"live ended with status {child.returncode}: {said}", *left]}
    lines[-1]["faults"] += left
    return dict(lines[-1])


# Modes


def run_trials(bags: Bags, out: Path, first: int, count: int, seconds: float, kinds: list[str]) -> None:
    """Do trials that are not done yet; a line each."""
    file = out / "trials.jsonl"
    done = {line["seed"] for line in read_lines(file)}
    ends_s = time.monotonic() + seconds
    for seed in range(first, first + count):
        if seed in done or time.monotonic() > ends_s:
            continue
        kind = kinds[seed % len(kinds)] if kinds else None
        line = Trial(seed, bags, out / f"trial_{seed}", kind).go()
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)


def same_draw(bags: Bags, out: Path, rounds: int) -> list[str]:
    """Four replays at once whose processes draw the same random numbers, again and again; return faults."""
    file = out / "same_draw.jsonl"
    before = "import random; random.seed({})"
    for number in range(len(read_lines(file)), rounds):
        folder = out / f"round_{number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        began, faults = time.monotonic(), []
        commands = {}
        for scene in Bags.SCENES:
            arguments = ["replay", str(bags.path(scene)), "--out", str(folder / scene), "--no-bag", *OPTIONS]
            bags.hash_of(scene)
            mark = f"{os.getpid()}-round-{number}"
            commands[scene] = Command(mark, arguments, folder / f"{scene}.said", before.format(number))
        for scene, command in commands.items():
            watch(command, None, faults)
            if command.process.returncode or grid_hash(folder / scene) != bags.hash_of(scene):
                faults.append(f"{scene}: exit status {command.process.returncode}, {command.said()}")
        faults += [line for command in commands.values() for line in command.left()]
        line = {"round": number, "wall_s": round(time.monotonic() - began, 1), "faults": faults}
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)
        if not faults:
            shutil.rmtree(folder)
    return [fault for line in read_lines(file) for fault in line["faults"]]


def two_graphs(bags: Bags, out: Path, circles: int, seed: int) -> list[str]:
    """Two live graphs in one domain and two namespaces, each circling contacts in an order of its own."""
    from concurrent.futures import ThreadPoolExecutor

    from csas_shadow_ros.graph.processes import DomainReservation

    for scene in Bags.SCENES:
        bags.hash_of(scene)  # both need them, and would make them at once
    with DomainReservation() as domain, ThreadPoolExecutor(2) as pool:
        told = []
        for number in range(2):
            folder = out / f"vehicle_{number}"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            more = ["--circles", str(circles), "--kills", "0", "--first", str(number)]
            more += ["--domain", str(domain), "--namespace", f"/vehicle_{number}/csas"]
            mark = f"{os.getpid()}-vehicle-{number}"
            told.append(pool.submit(live_child, mark, bags, folder, seed + number, *more))
        lines = [one.result() for one in told]
    with (out / "two_graphs.jsonl").open("a", encoding="utf-8") as file:
        for line in lines:
            file.write(json.dumps(line) + "\n")
            print(json.dumps(line), flush=True)
    return [fault for line in lines for fault in line["faults"]]


def circles(bags: Bags, out: Path, count: int, seed: int) -> None:
    """Circle after circle in one live graph that is recorded, with one to four kills in each."""
    folder = out / f"circles_{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    more = ["--circles", str(count), "--kills", "0", "--kills-a-circle", "4"]
    line = live_child(f"{os.getpid()}-circles", bags, folder, seed, *more)
    with (out / "circles.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"seed": seed, **line}) + "\n")
    print(json.dumps(line), flush=True)


def soak(bags: Bags, out: Path, seconds: float, seed: int) -> None:
    """Circle after circle in one live graph: the memory of every process."""
    folder = out / "soak"
    folder.mkdir(parents=True, exist_ok=True)
    more = ["--seconds", str(seconds), "--kills", "0", "--rest", "1"]
    line = live_child(f"{os.getpid()}-soak", bags, folder, seed, *more)
    with (out / "soak.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    print(json.dumps(line), flush=True)


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Return the lines of a file that may not be there, or end in the middle of one."""
    lines = []
    for text in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            lines.append(json.loads(text))
    return lines


def report(out: Path, tell: Callable[[str], None] = print) -> int:
    """Say what the lines of a folder tell; return how many things were wrong."""
    trials = read_lines(out / "trials.jsonl")
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for line in trials:
        by_kind.setdefault(line["kind"], []).append(line)
    tell(f"{'kind':14} trials kills stops faulty")
    for kind, lines in sorted(by_kind.items()):
        kills, stops = (sum(len(one[what]) for one in lines) for what in ("kills", "stops"))
        tell(f"{kind:14} {len(lines):6} {kills:5} {stops:5} {sum(bool(one['faults']) for one in lines):6}")
    kills = collections.Counter(name for line in trials for _, name in line["kills"])
    faults = [(line["seed"], fault) for line in trials for fault in line["faults"]]
    tell(f"{len(trials)} trials, {sum(kills.values())} kills: {dict(kills.most_common())}")
    tell(f"{sum(len(line['stops']) for line in trials)} stops")
    tell(f"views lost: {sum(line['lost'] for line in trials)}")
    tell(f"grids that differ: {sum('differs' in fault or 'in place' in fault for _, fault in faults)}")
    tell(f"runs that hung: {sum('hung' in fault for _, fault in faults)}")
    tell(f"runs that failed: {sum(fault.startswith(('exit status', 'a traceback')) for _, fault in faults)}")
    seconds = {"recovered_s": "from a kill to its successor", "extra_s": "longer than undisturbed"}
    for name, what in seconds.items():
        values = sorted(value for line in trials for value in line.get(name, ()))
        if values:
            p95 = values[int(0.95 * (len(values) - 1))]
            middle = statistics.median(values)
            tell(f"seconds {what}: median {middle:.2f}, p95 {p95:.2f}, most {values[-1]:.2f}")
    for seed, fault in faults:
        tell(f"  {seed}: {fault}")
    for name in ("circles", "same_draw", "two_graphs", "soak"):
        if lines := read_lines(out / f"{name}.jsonl"):
            wrong = [fault for line in lines for fault in line["faults"]]
            faults += [(name, fault) for fault in wrong]
            tell(f"{name}: {len(lines)} lines, {len(wrong)} faults {wrong[:5]}")
            for line in lines:
                if "circles" in line:
                    told = f"{line['circles']} circles in {line['wall_s']} s: {line['grids']} right grids"
                    told += f", {len(line['kills'])} kills, {line.get('lost', 0)} views lost"
                    tell(f"  {told}; {line.get('memory', '')}")
    return len(faults)


def main() -> int:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "soak", help="folder of lines and bags")
    parser.add_argument("--trials", type=int, default=0, help="trials to do")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first one")
    parser.add_argument("--kinds", default="", help=f"of {', '.join(dict.fromkeys(KINDS))}; default: all")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no trial after so long")
    parser.add_argument("--circles", type=int, default=0, help="in one live graph, with kills in each")
    parser.add_argument("--soak", type=float, default=0.0, metavar="SECONDS", help="circles in one graph")
    parser.add_argument("--same-draw", type=int, default=0, metavar="ROUNDS", help="four replays at once")
    parser.add_argument("--two-graphs", type=int, default=0, metavar="CIRCLES", help="in one domain")
    parser.add_argument("--report", action="store_true", help="only say what the lines tell")
    given = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    given.out.mkdir(parents=True, exist_ok=True)
    bags = Bags(given.out / "bags")
    if not given.report:
        kinds = [kind.strip() for kind in given.kinds.split(",") if kind.strip()]
        run_trials(bags, given.out, given.seed, given.trials, given.seconds, kinds)
        if given.same_draw:
            same_draw(bags, given.out, given.same_draw)
        if given.two_graphs:
            two_graphs(bags, given.out, given.two_graphs, given.seed)
        if given.circles:
            circles(bags, given.out, given.circles, given.seed)
        if given.soak:
            soak(bags, given.out, given.soak, given.seed)
    return int(report(given.out) > 0)


if __name__ == "__main__":
    sys.exit(main())
