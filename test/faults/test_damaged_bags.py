"""Damaged bags: refused, told, or read as the undamaged one is; never a traceback, a hang, or much memory.

``CSAS_DAMAGED_BAGS=1000 pytest test/faults/test_damaged_bags.py`` is the long form, ``python
test/faults/damage.py SEED 1`` shows one bag of it.
"""

from __future__ import annotations

import collections
import json
import os
import subprocess
import sys
from pathlib import Path

from damage import KINDS, judge, run_messages

BAGS = int(os.environ.get("CSAS_DAMAGED_BAGS", "300"))


def test_every_kind_of_bag_is_read_whole_and_without_a_word_while_it_is_sound(tmp_path):
    sound = run_messages()
    for n, make in enumerate(KINDS.values()):
        make(tmp_path / f"{n}", sound)
    assert {kind: judge(tmp_path / f"{n}", sound) for n, kind in enumerate(KINDS)} == {
        kind: ("whole", "") for kind in KINDS
    }


def test_a_damaged_bag_is_refused_or_told_or_read_as_the_sound_one():
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("damage.py")), "0", str(BAGS)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"},
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) == BAGS, done.stderr[-3000:]
    wrong = [line for line in lines if line["outcome"] == "wrong"]
    assert not wrong, json.dumps(wrong[:5], indent=1)
    # The damage is one that is noticed, and not so bad that nothing is left to read.
    outcomes = collections.Counter(line["outcome"] for line in lines)
    assert min(outcomes["told"], outcomes["refused"], outcomes["whole"]) > BAGS // 50, outcomes
