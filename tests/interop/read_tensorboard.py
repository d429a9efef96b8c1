"""What TensorBoard itself shows of event files: read_tensorboard.py FOLDER

Prints a JSON object: `scalars`, by run and tag a list of [step, value]; `sessions` of the HPARAMS tab, by name their
parameters, metrics and status; `parameters` and `metrics` that the tab has columns for."""

import json
import sys
import time
import urllib.parse
import urllib.request

from tensorboard import program

board = program.TensorBoard()
board.configure(argv=[None, "--logdir", sys.argv[1], "--port", "0", "--host", "127.0.0.1", "--load_fast=false"])
base = board.launch().rstrip("/")


def ask(path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{base}/data/{path}", data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


# It reads folders in the background, one after another: done once nothing has come for a while.
found, since = None, time.monotonic()
while True:
    tags = ask("plugin/scalars/tags")
    now = {run: sorted(t) for run, t in tags.items()}
    if now != found:
        found, since = now, time.monotonic()
    if found and time.monotonic() - since > 3:
        break
    if time.monotonic() - since > 60:
        sys.exit("TensorBoard found no runs")
    time.sleep(0.5)

scalars = {}
for run, tags in found.items():
    for tag in tags:
        query = urllib.parse.urlencode({"run": run, "tag": tag})
        points = ask(f"plugin/scalars/scalars?{query}")
        scalars.setdefault(run, {})[tag] = [[step, value] for _, step, value in points]

experiment = ask("plugin/hparams/experiment", {"experimentName": ""})
groups = ask(
    "plugin/hparams/session_groups",
    {
        "experimentName": "",
        "allowedStatuses": ["STATUS_SUCCESS", "STATUS_FAILURE", "STATUS_RUNNING", "STATUS_UNKNOWN"],
        "colParams": [],
        "startIndex": 0,
        "sliceSize": 1000,
    },
)
sessions = {
    session["name"]: {
        "parameters": group["hparams"],
        "metrics": {m["name"]["tag"]: m["value"] for m in session.get("metricValues", [])},
        "status": session["status"],
    }
    for group in groups.get("sessionGroups", [])
    for session in group["sessions"]
}
print(
    json.dumps(
        {
            "scalars": scalars,
            "sessions": sessions,
            "parameters": {p["name"]: p for p in experiment.get("hparamInfos", [])},
            "metrics": [m["name"]["tag"] for m in experiment.get("metricInfos", [])],
        }
    )
)
