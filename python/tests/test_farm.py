"""A farm of the module: jobs, errors, and the end of its processes."""

import asyncio
import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

import picofarm


def rooms(folder: pathlib.Path, **render: Any) -> dict[str, Any]:
    """A job that renders two small rooms into a store."""
    return {
        "name": "rooms",
        "stage": [
            {
                "name": "render",
                "kind": "render",
                "scenes": {"kind": "primitive", "seed": 1, "count": 2, "spots": None},
                "render": {"resolution": 8, "bins": 64, "bin_width_m": 0.4, "samples": 4, **render},
                "output": {"store": folder / "store", "dataset": "rooms"},
            }
        ],
    }


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[picofarm.LocalFarm]:
    with picofarm.local(tmp_path_factory.mktemp("farm")) as farm:
        yield farm


def test_a_job_is_planned_submitted_and_its_data_read(
    farm: picofarm.LocalFarm, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job = rooms(tmp_path)
    assert farm.plan(job)["run"] == 2
    done = farm.submit(job).wait()
    assert "2 of 2 tasks" in capsys.readouterr().err
    assert done.status()["state"] == "done"
    assert "2 of 2 tasks done" in repr(done)
    assert len(picofarm.open(tmp_path / "store" / "rooms")) == 2
    assert done.explain() == ["every task is done"]
    assert [entry["kind"] for entry in done.logs()][-1] == "ended"
    # The same job again is the same job.
    assert farm.submit(job).id == done.id
    assert farm.job(done.id[:13]).id == done.id
    assert done.id in [each["id"] for each in farm.jobs()]
    assert [worker["name"] for worker in farm.workers()] == ["local-1"]


def test_a_job_file_is_submitted_and_awaited(
    farm: picofarm.LocalFarm, tmp_path: pathlib.Path
) -> None:
    async def both() -> list[picofarm.Job]:
        jobs = [rooms(tmp_path / "a"), rooms(tmp_path / "b", samples=5)]
        submitted = await asyncio.gather(*map(farm.submit_async, jobs))
        return list(await asyncio.gather(*(job.wait_async() for job in submitted)))

    assert all(job.status()["state"] == "done" for job in asyncio.run(both()))


def test_errors_name_the_field_and_carry_the_hint(
    farm: picofarm.LocalFarm, tmp_path: pathlib.Path
) -> None:
    with pytest.raises(picofarm.FarmError, match="^job: .*did you mean `samples`") as refused:
        farm.submit(rooms(tmp_path, sample=3))
    assert refused.value.code == 3
    assert refused.value.hint and refused.value.hint in str(refused.value)
    with pytest.raises(picofarm.FarmError, match="no job"):
        farm.job("123")
    with pytest.raises(picofarm.FarmError, match="127.0.0.1:9"):
        picofarm.Client("http://127.0.0.1:9").jobs()
    with pytest.raises(TypeError, match="complex"):
        farm.submit(rooms(tmp_path, samples=1j))
    with pytest.raises(picofarm.FarmError, match="nothing"):
        picofarm.Sweep(tmp_path, "nothing")


def test_a_cancelled_job_raises_in_wait(farm: picofarm.LocalFarm, tmp_path: pathlib.Path) -> None:
    job = farm.submit(rooms(tmp_path, samples=1_000_000, resolution=64))
    with pytest.raises(TimeoutError, match="continues"):
        job.wait(progress=False, timeout=0.1)
    job.pause()
    assert job.status()["paused"]
    job.resume()
    job.cancel()
    with pytest.raises(picofarm.JobFailed, match="cancelled"):
        job.wait(progress=False)


def test_a_farm_ends_with_a_killed_interpreter(tmp_path: pathlib.Path) -> None:
    code = "import picofarm; print(picofarm.local('farm')._process.pid, flush=True); input()"
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path
    )
    assert child.stdout is not None
    farm = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    child.wait()
    while True:
        try:
            os.kill(farm, 0)
        except ProcessLookupError:
            break
        # A process that ended may wait to be reaped.
        if pathlib.Path(f"/proc/{farm}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
            break
        time.sleep(0.05)
    # Its folder is free again.
    picofarm.local(tmp_path / "farm").close()
