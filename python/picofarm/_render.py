"""Renders of scenes, and what a sensor counts of them."""

from __future__ import annotations

import base64
import html
import io
import json
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._arguments import DIMENSIONS, Floats, Gate, count, optional, to_xarray, whole
from ._flash import Capture, Flash, Reconstruction

if TYPE_CHECKING:
    import matplotlib.figure
    import xarray

    from ._scene import Scene


@dataclass(frozen=True, repr=False)
class Render:
    """Histograms of one scene and its ground truth. Rows count downwards."""

    scene: Scene
    gate: Gate
    transient: Floats
    """All light, radiance per pulse energy, 1/(m² sr), `[row, column, bin]`."""
    depth: Floats
    """z-depth, metres, 0 = nothing, `[row, column]`."""
    range: Floats
    """Distance along the ray, metres, 0 = nothing, `[row, column]`."""
    normal: Floats
    """Unit normals in the camera frame (x right, y down, z forward), `[row, column, 3]`."""
    instance: NDArray[np.uint32]
    """Object index + 1, 0 = nothing, `[row, column]`."""
    label: NDArray[np.uint16]
    """Category index + 1, 0 = nothing, `[row, column]`."""
    specular: NDArray[np.uint8]
    """1 = mirror, `[row, column]`."""
    visibility: NDArray[np.uint8]
    """1 = the spot lights what the pixel sees, `[spot, row, column]`."""
    rgb: Floats
    """Companion image, linear, 0 to 1, `[row, column, 3]`."""
    spots: Floats
    """x, y, z, nx, ny, nz (world frame) and the path from the laser, metres, `[spot, 7]`; NaN if
    the beam hits nothing."""
    intrinsics: Floats
    """fx, fy, cx, cy, pixels."""
    facts: dict[str, Any] = field(repr=False)
    """Error estimates, the renderer's plan, energy outside the gate, rays and warnings."""
    two: Floats | None = None
    """Light of exactly two bounces, with `split=True`."""
    two_se: Floats | None = None
    """Standard error of `two`."""
    two_noise: Floats | None = None
    """A draw of the error of `two`."""
    multi: Floats | None = None
    """Light of three bounces and more, with `split=True`."""
    multi_se: Floats | None = None
    """Standard error of `multi`."""
    multi_noise: Floats | None = None
    """A draw of the error of `multi`."""

    @property
    def error(self) -> float:
        """Median over the pixels of the relative error of the histogram."""
        return self.facts["error"]["median_relative"]

    @property
    def plan(self) -> dict[str, list[str]]:
        """Techniques and approximations that the renderer chose."""
        return self.facts["plan"]

    @property
    def warnings(self) -> list[str]:
        """Beams that hit nothing, an image without light."""
        return self.facts["warnings"]

    def sense(
        self,
        sensor: Mapping[str, Any] | None = None,
        *,
        peak_photons: float | tuple[float, float] | None = None,
        seed: int = 0,
        number: int = 0,
        threads: int | None = None,
    ) -> Sensed:
        """Returns what a single-photon sensor counts. The same arguments give the same counts.

        Args:
            sensor: Settings as in a job file: `preset` (`vl53l8ch`, `tmf8828`, `ads6311`),
                `pulse`, `jitter`, `scale`, `dark_per_bin`, `poisson`, `rebin`, `dead_time`,
                `zones`, `gate`, `crosstalk` and `afterpulsing`. Without them, a pulse of 128 ps,
                50 ps of jitter and a peak of 10 to 400 photons.
            peak_photons: Photons in the brightest bin of the median pixel, or a range to draw
                from. Replaces `scale` of `sensor`.
            seed: Seed of the noise.
            number: Number of the scene, which selects its own noise.
            threads: Number of threads; all cores without it.

        Raises:
            ValueError: A setting is unusable.
        """
        spec = dict(sensor or {})
        if isinstance(peak_photons, Sequence):
            low, high = peak_photons
            spec["scale"] = {"kind": "peak_range", "low": float(low), "high": float(high)}
        elif peak_photons is not None:
            spec["scale"] = {"kind": "peak", "photons": float(peak_photons)}
        made = _native.sense(
            self.transient,
            self.two,
            self.gate.start_m,
            self.gate.bin_width_m,
            json.dumps(spec),
            whole("seed", seed),
            whole("number", number),
            count("threads", threads),
        )
        facts = json.loads(made["facts"])
        gate = Gate(facts["start_m"], facts["bin_width_m"], facts["bins"])
        return Sensed(render=self, gate=gate, counts=made["counts"], facts=facts)

    def demultiplex(
        self,
        *,
        histogram: ArrayLike | None = None,
        shadows: str = "learned",
        threads: int | None = None,
    ) -> Flash:
        """Finds depth, shadows and mirrors in the light of all spots, without the ground truth.

        Args:
            histogram: Replaces `transient`, for example with a measured one.
            shadows: `learned` from rendered rooms, or `physics`.
            threads: Number of threads; all cores without it.
        """
        capture = self._capture(self.transient if histogram is None else histogram, self.gate)
        return capture.demultiplex(shadows=shadows, threads=threads)

    def _capture(self, histogram: ArrayLike, gate: Gate) -> Capture:
        return Capture._of_render(histogram, gate, self.scene, self.spots)

    def reconstruct(
        self,
        *,
        histogram: ArrayLike | None = None,
        nodes: int | None = None,
        seed: int = 0,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Reconstruction:
        """Returns the room in 3D from the light of all spots, and its errors against the scene.

        Args:
            histogram: Replaces `transient`, for example with a measured one.
            nodes: Nodes along the longest side of the grid, 16 to 512; 192 without it.
            seed: Seed of the random numbers.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: The histogram contradicts the scene's calibration, or an argument is wrong.
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        capture = self._capture(self.transient if histogram is None else histogram, self.gate)
        return capture.reconstruct(nodes=nodes, seed=seed, threads=threads, progress=progress)

    def to_xarray(self) -> xarray.Dataset:
        """Returns the arrays with dimensions, coordinates and units. Needs xarray."""
        arrays = {name: value for name, value in vars(self).items() if name in DIMENSIONS}
        return to_xarray(arrays, self.gate, 0, {"scene": self.scene.name})

    def plot(self, pixel: tuple[int, int] | None = None) -> matplotlib.figure.Figure:
        """Draws the light summed over time, the depth and the histogram of a pixel. Needs
        matplotlib.

        Args:
            pixel: Row and column; the middle of the image without it.
        """
        plt = optional("matplotlib.pyplot", "plot")
        height, width = self.depth.shape
        row, column = pixel or (height // 2, width // 2)
        if not (0 <= row < height and 0 <= column < width):
            raise ValueError(f"pixel: {(row, column)} is outside of {height} rows, {width} columns")
        figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
        light = self.transient.sum(axis=2)
        white = float(np.quantile(light, 0.99)) or 1.0
        axes[0].imshow(np.sqrt(np.minimum(light / white, 1.0)), cmap="inferno")
        axes[0].set_title("all light")
        seen = np.where(self.depth > 0, self.depth, np.nan)
        figure.colorbar(axes[1].imshow(seen, cmap="viridis"), ax=axes[1], label="depth, m")
        for panel in axes[:2]:
            panel.plot(column, row, "o", mfc="none", mec="white")
            panel.set_xticks([])
            panel.set_yticks([])
        axes[2].plot(self.gate.times_ns, self.transient[row, column], lw=0.8)
        axes[2].set_xlabel("time, ns")
        axes[2].set_ylabel("radiance, 1/(m² sr)")
        axes[2].set_title(f"pixel ({row}, {column})")
        return figure

    def animate(
        self, file: str | os.PathLike[str], *, frames: int = 100, fps: int = 20
    ) -> pathlib.Path:
        """Writes light in flight as a GIF (or MP4, with ffmpeg) and returns its path. Needs
        matplotlib.

        Args:
            file: Where to write. The extension selects the format.
            frames: Number of frames, from the first light to the last.
            fps: Frames per second.
        """
        plt = optional("matplotlib.pyplot", "plot")
        animation = optional("matplotlib.animation", "plot")
        lit = np.flatnonzero(self.transient.any(axis=(0, 1)))
        first, last = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, self.gate.bins)
        edges = np.unique(np.linspace(first, last, whole("frames", frames) + 1).astype(int))
        white = float(np.quantile(self.transient[..., first:last].max(axis=2), 0.9)) or 1.0
        figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
        height, width = self.depth.shape
        image = axes.imshow(np.zeros((height, width)), cmap="inferno", vmin=0, vmax=1)
        axes.set_xticks([])
        axes.set_yticks([])
        times = self.gate.times_ns

        def draw(k: int) -> tuple[Any, ...]:
            light = self.transient[..., edges[k] : edges[k + 1]].max(axis=2)
            image.set_data(np.sqrt(np.minimum(light / white, 1.0)))
            axes.set_title(f"{times[edges[k]]:.2f} ns")
            return (image,)

        path = pathlib.Path(file)
        movie = animation.FuncAnimation(figure, draw, frames=len(edges) - 1)
        movie.save(path, writer="pillow" if path.suffix == ".gif" else None, fps=fps)
        plt.close(figure)
        return path

    def _repr_html_(self) -> str:
        try:
            figure: Any = self.plot()
        except ImportError:
            return f"<p>{html.escape(repr(self))}</p>"
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=80)
        optional("matplotlib.pyplot", "plot").close(figure)
        data = base64.b64encode(buffer.getvalue()).decode()
        title = html.escape(repr(self))
        return f'<p>{title}</p><img alt="{title}" src="data:image/png;base64,{data}">'

    def __repr__(self) -> str:
        height, width, bins = self.transient.shape
        return f"<picofarm.Render {width}x{height} pixels, {bins} bins, error {self.error:.1%}>"


@dataclass(frozen=True, repr=False)
class Sensed:
    """What a sensor counted."""

    render: Render
    """The measured light."""
    gate: Gate
    """The gate of the counts."""
    counts: NDArray[np.uint32] | Floats
    """Photons, `[row, column, bin]`; expected photons if `poisson` is off."""
    facts: dict[str, Any] = field(repr=False)
    """Settings, photons that the gate or pile-up dropped, and what set the scale."""

    @property
    def scale(self) -> float:
        """Photons per unit of `Render.transient`."""
        return self.facts["scale"]

    def demultiplex(self, *, shadows: str = "learned", threads: int | None = None) -> Flash:
        """Finds depth, shadows and mirrors in the counts. See `Render.demultiplex`."""
        capture = self.render._capture(self.counts, self.gate)
        return capture.demultiplex(shadows=shadows, threads=threads)

    def reconstruct(
        self,
        *,
        nodes: int | None = None,
        seed: int = 0,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Reconstruction:
        """Returns the room in 3D from the counts. See `Render.reconstruct`."""
        capture = self.render._capture(self.counts, self.gate)
        return capture.reconstruct(nodes=nodes, seed=seed, threads=threads, progress=progress)

    def __repr__(self) -> str:
        height, width, bins = self.counts.shape
        photons = float(self.counts.sum(dtype=np.float64)) / (height * width)
        return f"<picofarm.Sensed {width}x{height} pixels, {bins} bins, {photons:.0f} photons each>"
