"""Farms: submit jobs, follow them, and read the results of sweeps."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import pandas

_File = str | os.PathLike[str] | Mapping[str, Any]


class FarmError(RuntimeError):
    """A refused request. The message ends with a hint if there is one."""

    def __init__(self, message: str, hint: str | None = None, code: int = 1) -> None:
        super().__init__(message if hint is None else f"{message}\nhint: {hint}")
        self.message = message
        """What is wrong."""
        self.hint = hint
        """How to fix it."""
        self.code = code
        """Exit code of the command line: 3 = input, 4 = coordinator, 5 = resources."""


class JobFailed(FarmError):
    """A job ended without finishing all of its tasks."""


class Client:
    """A connection to a farm.

    The methods run the commands of the program, so a job file, a field and an error are the same in
    Python and on the command line. A call takes about 0.2 s.

    Args:
        url: URL of the coordinator; several, separated by commas. Without it, the environment
            variable `PICOFARM_COORDINATOR` or the settings file.
        token: Your token, if the farm asks for one. Without it, `PICOFARM_TOKEN` or the settings.
        ca: File with the certificate authority of the coordinator, PEM.
        cert: File with a client certificate, PEM.
        key: File with the private key of `cert`, PEM.
    """

    def __init__(
        self,
        url: str | None = None,
        token: str | None = None,
        *,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
    ) -> None:
        given = {"COORDINATOR": url, "TOKEN": token, "CA": ca, "CERT": cert, "KEY": key}
        self._variables = {
            f"PICOFARM_{name}": os.fspath(value)
            for name, value in given.items()
            if value is not None
        }

    def submit(self, job: _File, *, scale: str | None = None, again: bool = False) -> Job:
        """Submits a job and returns it. The same job again returns the same job.

        Args:
            job: Path of a job file, or a dict with the same fields. Paths in a dict start at the
                current folder.
            scale: Name of one of the job's sizes.
            again: Submit again after the same job failed or was cancelled.

        Raises:
            FarmError: The job is invalid, or the farm cannot be reached.
        """
        more = ["--again"] if again else []
        made = self._with_job("submit", job, scale, more)
        return Job(self, made["job"])

    async def submit_async(
        self, job: _File, *, scale: str | None = None, again: bool = False
    ) -> Job:
        """Like `submit`, for use in a coroutine."""
        return await asyncio.to_thread(self.submit, job, scale=scale, again=again)

    def plan(self, job: _File, *, scale: str | None = None) -> dict[str, Any]:
        """Returns what `submit` would run and reuse, and changes nothing."""
        return self._with_job("plan", job, scale, [])

    def job(self, job: str) -> Job:
        """Returns a job by its id, or by the first letters of its id.

        Raises:
            FarmError: There is no such job.
        """
        return Job(self, self._run(["job", "status", job])["id"])

    def jobs(self) -> list[dict[str, Any]]:
        """Returns the newest jobs, the latest first: id, name, user, state and counts of tasks."""
        return self._run(["job", "list"])["jobs"]

    def workers(self) -> list[dict[str, Any]]:
        """Returns the connected workers."""
        return self._run(["workers"])["workers"]

    def _with_job(
        self, command: str, job: _File, scale: str | None, more: Sequence[str]
    ) -> dict[str, Any]:
        options = [*more] if scale is None else ["--scale", scale, *more]
        if isinstance(job, Mapping):
            text = json.dumps(_without_none(job), default=_number)
            try:
                return self._run(["job", command, "-", *options], text)
            except FarmError as e:
                message = e.message.replace("-: ", "job: ", 1)
                raise FarmError(message, e.hint, e.code) from None
        return self._run(["job", command, os.fspath(job), *options])

    def _run(self, arguments: Sequence[str], text: str | None = None) -> Any:
        return run(arguments, self._variables, text)

    def __repr__(self) -> str:
        url = self._variables.get("PICOFARM_COORDINATOR", "of the settings")
        return f"<picofarm.Client {url}>"


class Job:
    """A submitted job."""

    def __init__(self, client: Client, job: str) -> None:
        self._client = client
        self.id = job
        """Id of the job."""

    def status(self) -> dict[str, Any]:
        """Returns the present state: `state` (active, done, failed or cancelled), counts of `tasks`,
        `stages`, running tasks and the job's `spec`."""
        return self._client._run(["job", "status", self.id])

    def wait(self, *, progress: bool = True, timeout: float | None = None) -> Job:
        """Waits until the job ends, and returns it.

        Args:
            progress: Shows a bar on standard error.
            timeout: Longest time to wait, seconds. The job continues afterwards.

        Raises:
            JobFailed: The job failed or was cancelled.
            TimeoutError: The job did not end in time.
        """
        state: dict[str, Any] = {}
        bar = _Bar() if progress else None
        limit = None if timeout is None else time.monotonic() + timeout
        while True:
            state = self.status()
            if bar is not None:
                bar.show(state)
            if state["state"] != "active":
                break
            if limit is not None and time.monotonic() > limit:
                raise TimeoutError(f"job {self.id} has not ended in {timeout} s; it continues")
            time.sleep(0.5)
        if bar is not None:
            bar.end()
        if state["state"] != "done":
            raise self._failure(state)
        return self

    async def wait_async(self, *, timeout: float | None = None) -> Job:
        """Like `wait`, for use in a coroutine. Shows no bar."""
        limit = None if timeout is None else time.monotonic() + timeout
        while True:
            state = await asyncio.to_thread(self.status)
            if state["state"] == "done":
                return self
            if state["state"] != "active":
                raise self._failure(state)
            if limit is not None and time.monotonic() > limit:
                raise TimeoutError(f"job {self.id} has not ended in {timeout} s; it continues")
            await asyncio.sleep(0.5)

    def logs(
        self, *, last: int = 100, stage: str | None = None, task: int | None = None
    ) -> list[dict[str, Any]]:
        """Returns the history of the job, the latest entry last: `at_ms`, `kind`, `stage`, `task`,
        `worker` and `message`. With `task`, also what the task logged on its worker."""
        arguments = ["job", "logs", self.id, "--last", str(last)]
        if stage is not None:
            arguments += ["--stage", stage]
        if task is not None:
            arguments += ["--task", str(task)]
        return self._client._run(arguments)

    def explain(self) -> list[str]:
        """Returns why the job does not run, or why it ended, in sentences."""
        found = self._client._run(["job", "explain", self.id])
        return [reason["words"] for reason in found["reasons"]]

    def cancel(self) -> None:
        """Cancels the job. Its finished results remain."""
        self._client._run(["job", "cancel", self.id])

    def pause(self) -> None:
        """Pauses the job: running tasks continue, and no other task starts."""
        self._client._run(["job", "pause", self.id])

    def resume(self) -> None:
        """Continues a paused job."""
        self._client._run(["job", "resume", self.id])

    def retry(self) -> None:
        """Runs the dead tasks again."""
        self._client._run(["job", "retry", self.id])

    def _failure(self, state: Mapping[str, Any]) -> JobFailed:
        tasks = state["tasks"]
        what = f"job {state['name']!r} ({self.id}) {_ENDS[state['state']]}: "
        what += f"{tasks['done']} of {tasks['total']} tasks done, {tasks['dead']} dead"
        dead = [entry for entry in self.logs() if entry["kind"] == "dead" and entry["message"]]
        if dead:
            what += f"; the last: {dead[-1]['message']}"
        return JobFailed(what, "`logs()` has the history, and `retry()` runs dead tasks again")

    def __repr__(self) -> str:
        state = self.status()
        tasks = state["tasks"]
        counts = f"{tasks['done']} of {tasks['total']} tasks done"
        return f"<picofarm.Job {state['name']!r} {self.id}: {state['state']}, {counts}>"


_ENDS = {"failed": "failed", "cancelled": "was cancelled"}


class LocalFarm(Client):
    """A farm on this machine that ends with this object: a coordinator and its workers.

    Use it in a `with` statement, or call `close`. It also ends when the interpreter does, even if
    the interpreter is killed. Unfinished jobs continue when a farm starts in the same folder.
    """

    def __init__(
        self, folder: str | os.PathLike[str], workers: int, gpus: int, python: str | None
    ) -> None:
        command = ["up", "--no-web", "--dir", os.fspath(folder), "--listen", "127.0.0.1:0"]
        command += ["--workers", str(workers), "--gpus", str(gpus)]
        if python is not None:
            command += ["--python", python]
        # Standard input stays open as long as this process lives.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "picofarm._attached", "--json", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Ctrl-C interrupts the caller, not the farm.
            start_new_session=True,
        )
        assert self._process.stdout is not None and self._process.stderr is not None
        line = self._process.stdout.readline()
        if not line:
            _, errors = self._process.communicate()
            raise _error(errors, self._process.returncode)
        # Nobody reads the log of the workers: jobs have their own.
        self._drain(self._process.stderr)
        self.url: str = json.loads(line)["coordinator"]
        """URL of the coordinator."""
        super().__init__(self.url)

    def _drain(self, pipe: Any) -> None:
        import threading

        def read() -> None:
            for _ in pipe:
                pass

        threading.Thread(target=read, daemon=True, name="picofarm-log").start()

    def close(self) -> None:
        """Ends the farm. Running tasks are handed back, and finished results remain."""
        if self._process.poll() is None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.wait()

    def __enter__(self) -> LocalFarm:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "running" if self._process.poll() is None else "ended"
        return f"<picofarm.LocalFarm {self.url}: {state}>"


def local(
    folder: str | os.PathLike[str] = "picofarm-data",
    *,
    workers: int = 1,
    gpus: int = 0,
    python: str | os.PathLike[str] | bool = False,
) -> LocalFarm:
    """Starts a farm on this machine and returns its client.

        with picofarm.local() as farm:
            farm.submit("job.toml").wait()

    Args:
        folder: Where the farm keeps its catalog. A farm in the same folder continues the jobs.
        workers: Number of workers; they share the cores.
        gpus: Number of graphics processors, divided among the workers.
        python: Interpreter for stages of kind `python` and trainings by PyTorch; `True` is this
            one. Without it, the farm runs no Python code of jobs.

    Raises:
        FarmError: The folder is in use or cannot be written.
    """
    interpreter = sys.executable if python is True else os.fspath(python) if python else None
    return LocalFarm(folder, int(workers), int(gpus), interpreter)


class Sweep:
    """The trials of a sweep.

    Args:
        store: Folder or URL of the store of the models.
        name: Name of the sweep, which is the name of its model.

    Raises:
        FarmError: There is no such sweep.
    """

    def __init__(self, store: str | os.PathLike[str], name: str) -> None:
        self.store = os.fspath(store)
        self.name = name
        self._facts: dict[str, Any] = {}
        self.refresh()

    def refresh(self) -> None:
        """Reads the trials again."""
        self._facts = run(["sweep", "status", self.store, self.name])

    @property
    def trials(self) -> list[dict[str, Any]]:
        """Facts of each trial: index, model, values of the parameters, epochs, how it ended, and
        its error."""
        return self._facts["trials"]

    @property
    def error(self) -> str:
        """Name of the error that trials are compared by, with its unit."""
        return self._facts["error"]

    @property
    def best(self) -> dict[str, Any]:
        """The finished trial with the least error."""
        return run(["sweep", "best", self.store, self.name])

    def results(self) -> pandas.DataFrame:
        """Returns a row for each trial and a column for each parameter. Needs pandas."""
        try:
            import pandas
        except ImportError as e:
            raise ImportError(f"{e}; pip install 'picofarm[farm]'") from None
        rows = [
            {
                "trial": trial["index"],
                **dict(trial["values"]),
                "end": trial["end"],
                "epochs": trial["epochs"],
                self.error: trial["loss"],
                "model": trial["model"],
            }
            for trial in self.trials
        ]
        return pandas.DataFrame(rows)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self.trials)

    def __len__(self) -> int:
        return len(self.trials)

    def __repr__(self) -> str:
        return f"<picofarm.Sweep {self.name!r}: {len(self)} trials>"


class _Bar:
    """One line on standard error that shows the progress of a job."""

    def __init__(self) -> None:
        self.last = ""

    def show(self, state: Mapping[str, Any]) -> None:
        tasks = state["tasks"]
        done, total = tasks["done"], max(tasks["total"], 1)
        full = 30 * done // total
        line = f"{state['name']} [{'#' * full}{'.' * (30 - full)}] {done} of {tasks['total']} tasks"
        if tasks["dead"]:
            line += f", {tasks['dead']} dead"
        if line != self.last:
            padding = " " * max(0, len(self.last) - len(line))
            print(f"\r{line}{padding}", end="", file=sys.stderr, flush=True)
            self.last = line

    def end(self) -> None:
        print(file=sys.stderr)


def run(
    arguments: Sequence[str], variables: Mapping[str, str] | None = None, text: str | None = None
) -> Any:
    """Runs a command of the program and returns its JSON document."""
    command = [sys.executable, "-m", "picofarm", "--json", *arguments]
    environment = {**os.environ, **(variables or {})}
    ended = subprocess.run(
        command, input=text or "", capture_output=True, text=True, env=environment, check=False
    )
    if ended.returncode != 0:
        raise _error(ended.stderr, ended.returncode)
    return json.loads(ended.stdout) if ended.stdout.strip() else None


def _error(text: str, code: int) -> FarmError:
    """Returns the error that a command printed as JSON."""
    for line in reversed(text.splitlines()):
        try:
            found = json.loads(line)["error"]
        except (ValueError, KeyError, TypeError):
            continue
        return FarmError(found["message"], found.get("hint"), found["code"])
    return FarmError(text.strip() or f"picofarm ended with code {code}", None, code)


def _without_none(value: Any) -> Any:
    """Returns a job without the fields that are None."""
    if isinstance(value, Mapping):
        items = cast("Mapping[object, Any]", value).items()
        return {str(key): _without_none(item) for key, item in items if item is not None}
    if isinstance(value, (list, tuple)):
        return [_without_none(item) for item in cast("Sequence[Any]", value)]
    return value


def _number(value: Any) -> Any:
    """Returns a plain number, or the text of a path."""
    if isinstance(value, os.PathLike):
        return os.fspath(cast("os.PathLike[str]", value))
    plain: Callable[[], Any] | None = getattr(value, "tolist", None)
    if plain is None:
        raise TypeError(f"a job holds {type(value).__name__}, which is not plain data")
    return plain()
