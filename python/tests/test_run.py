"""`picofarm.run` outside of a farm: the same file runs on its own."""

import pathlib
import subprocess
import sys

SCRIPT = """
import pathlib
from picofarm import run

state = run.resume({"epoch": 0})
assert not run.inside and not run.stopped
while state["epoch"] < run.parameters.get("epochs", 2):
    state["epoch"] += 1
    run.report(epoch=state["epoch"], loss=0.5)
    assert run.checkpoint(state, step=state["epoch"]) is False
run.progress(1.0)
pathlib.Path("out.txt").write_text("x")
run.artifact("out.txt")
"""


def test_a_training_runs_by_hand(tmp_path: pathlib.Path) -> None:
    (tmp_path / "train.py").write_text(SCRIPT)
    ran = subprocess.run(
        [sys.executable, "train.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ran.stderr.splitlines() == ["epoch 1, loss 0.5", "epoch 2, loss 0.5"]
