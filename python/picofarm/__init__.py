"""Time-resolved light: renderer, data sets and render farm.

    import picofarm

    room = picofarm.furnished(seed=7)
    render = room.render(64, error=0.1)
    render.transient            # float32 [row, column, bin]
    render.plot()

`Scene` opens scene files and arrays, `open` opens data sets, and `Client` submits jobs to a farm,
which `local` starts on this machine. The command line `picofarm` is part of the package. Lengths
are metres of optical path, times are nanoseconds.
"""

from ._arguments import Gate
from ._data import Dataset, Stream, open
from ._farm import Client, FarmError, Job, JobFailed, LocalFarm, Sweep, local
from ._flash import Capture, Flash, Reconstruction
from ._model import Model
from ._native import __version__
from ._render import Render, Sensed
from ._scene import Scene, furnished

__all__ = [
    "Capture",
    "Client",
    "Dataset",
    "FarmError",
    "Flash",
    "Gate",
    "Job",
    "JobFailed",
    "LocalFarm",
    "Model",
    "Reconstruction",
    "Render",
    "Scene",
    "Sensed",
    "Stream",
    "Sweep",
    "__version__",
    "furnished",
    "local",
    "open",
]
