"""Trained networks without PyTorch."""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._arguments import count, floats


class Model:
    """A trained network of a store, run by the program's own kernels. It needs no PyTorch.

    The bits are those that the farm computes on the same processor. `picofarm.torch.load` returns
    the same network as a PyTorch module.

    Args:
        store: Folder or URL of the store, for example `picofarm-data/store`.
        name: Name of the model; `picofarm model list` shows all.

    Raises:
        ValueError: There is no such model, or another version made it.
        OSError: The store cannot be read, or the weights are damaged.
        RuntimeError: The package was built without networks.
    """

    def __init__(self, store: str | os.PathLike[str], name: str) -> None:
        self.store, self.name = os.fspath(store), name
        if not hasattr(_native, "Model"):
            what = "this build has no networks"
            raise RuntimeError(f"{what}; build it with `--features networks`")
        self._native = _native.Model(self.store, name)
        self.manifest: dict[str, Any] = json.loads(self._native.manifest())
        """Settings, plan, lineage and metrics."""
        self.question: dict[str, Any] = self.manifest["plan"]["plan"]["question"]
        """Target and form of the input."""

    def predict(
        self,
        transient: ArrayLike,
        *,
        depth: ArrayLike | None = None,
        spots: ArrayLike | None = None,
        intrinsics: ArrayLike | None = None,
        threads: int | None = None,
    ) -> NDArray[np.float32]:
        """Returns z-depth in metres, `[row, column]`, from a model of `tof`; probabilities of
        light, `[spot, row, column]`, from one of `shadow`; and of mirrors, `[row, column]`, from
        one of `specular`.

        Args:
            transient: Histograms of one scene, `[row, column, bin]`, with the gate that the model
                was trained on.
            depth: z-depth in metres, `[row, column]`. Models of `shadow` compute two-bounce times
                from it, except for the variants `all` and `index`.
            spots: Rows of x, y, z, …, path of the beam, as in a data set's scene; with `depth`.
            intrinsics: fx, fy, cx, cy in pixels; with `depth`.
            threads: Number of threads; all cores without it. Results are the same.

        Raises:
            ValueError: An argument does not fit the model.
        """
        if spots is not None:
            rows = floats("spots", spots, 2)
            if rows.shape[1] < 4:
                raise ValueError(f"spots: expected at least 4 columns, found {rows.shape[1]}")
            spots = np.ascontiguousarray(rows[:, [0, 1, 2, -1]])
        camera: list[float] | None = None
        if intrinsics is not None:
            values = np.asarray(intrinsics, np.float64)
            if values.shape != (4,):
                raise ValueError(f"intrinsics: expected fx, fy, cx, cy, found shape {values.shape}")
            camera = values.tolist()
        planes = self._native.predict(
            floats("transient", transient, 3),
            None if depth is None else floats("depth", depth, 2),
            spots,
            camera,
            count("threads", threads),
        )
        return planes if self.question["target"] == "shadow" else planes[0]

    def __repr__(self) -> str:
        return f"<picofarm.Model {self.name!r} of {self.store!r}: {self.question['target']}>"
