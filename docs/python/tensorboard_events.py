"""Converts curves of trainings to TensorBoard event files: tensorboard_events.py REPORT.json FOLDER

REPORT.json is what `picofarm sweep report` or `picofarm model report` writes next to its page. Each trial or model becomes
a run: loss, learning rate and validation by step. For trials, the HPARAMS tab shows parameters and the final error."""

import json
import sys
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams.summary_v2 import hparams_pb
from tensorboard.summary.writer.event_file_writer import EventFileWriter


def scalars(values, prefix=""):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from scalars(value, f"{prefix}{name}/")
        elif isinstance(value, (int, float)):
            yield Summary.Value(tag=prefix + name, simple_value=value)


report = json.loads(Path(sys.argv[1]).read_text())
for run in report.get("trials") or report.get("models"):
    name = run.get("model") or run["name"]
    writer = EventFileWriter(str(Path(sys.argv[2], name)))
    if run.get("values"):
        writer.add_event(Event(summary=hparams_pb(dict(run["values"]), trial_id=name, start_time_secs=0)))
    for line in run["history"]:
        # Reports have no times, so that an event's time is its step.
        step = line.pop("step")
        writer.add_event(Event(step=step, wall_time=step, summary=Summary(value=scalars(line))))
    if run.get("loss") is not None and run["history"]:
        error = Summary.Value(tag="error", simple_value=run["loss"])
        writer.add_event(Event(step=step, wall_time=step, summary=Summary(value=[error])))
    writer.close()
