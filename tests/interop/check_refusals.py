"""What docs/python/transients.py must refuse, with words that help: check_refusals.py DATASET.

Its scene 4 has no scale, as if it were not published yet.
"""

import os
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "docs" / "python"))
from transients import Transients

location = sys.argv[1]


def refused(parts, *args, call=Transients, **named):
    try:
        call(*args, **named)
    except Exception as error:
        if all(part in str(error) for part in parts):
            return
        sys.exit(f"{args} {named}: {error!r} does not say {parts}")
    sys.exit(f"{args} {named} was taken")


refused(["train", "validation", "test"], location, split="dev")
refused(["picofarm dataset split", "'other'"], location, split="train", split_name="other")
refused(["v9.json"], location, split="train", split_version=9)
refused(["not both"], location, scenes=[0], split="train")
refused(["colour", "depth"], location, arrays=["colour"])
scenes = Transients(location)
refused(["crop", "32x32"], 0, call=scenes.read, crop=(16, 0, 17, 8))
refused(["bins", "within 0 to"], 0, call=scenes.read, bins=(8, 1000))
refused(["scene 4 is not published"], 4, call=scenes.read)
child = os.fork()
if child == 0:
    try:
        scenes[0]
    except RuntimeError as error:
        os._exit(0 if "spawn" in str(error) else 1)
    os._exit(2)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, "a fork must be refused with the way out"
print("all refused")
