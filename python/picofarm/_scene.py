"""Scenes: read from files, generated, or made of arrays."""

from __future__ import annotations

import json
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from . import _native
from ._arguments import Gate, Point, Spots, count, mesh_arrays, plain, point, size, watcher, whole
from ._render import Render


class Scene:
    """Objects, a camera and a laser. A scene never changes.

    `source` is one of:

    - the path of a glTF, Mitsuba (XML, or its dict as JSON), OBJ, PLY or STL file,
    - a Mitsuba dict,
    - a list of meshes. Each is a dict with `vertices` (float, `[n, 3]`, metres), `triangles`
      (integer, `[m, 3]`), and optionally `rgb` (three numbers from 0 to 1) and `mirror` (the
      roughness of a mirror).

    Camera, laser and unit that the source does not have are chosen; `notes` lists the choices.

    Args:
        camera: Name or number of the file's camera.
        look_from: Position of the camera, metres.
        look_at: Point in the middle of the image, metres.
        fov: Width of the view, degrees.
        up: Direction that is upwards in the image.
        spots: Laser spots in the camera's view: a grid of 1, 4, 16, 25 or 100, `"random:16"`, or
            a list of (x, y) from 0 to 1, right and down.
        unit: Unit of length of the file: m, cm, mm, in or ft.
        root: Folder that holds every file that the scene names.

    Raises:
        ValueError: An argument or the content of the source is unusable.
        OSError: A file cannot be read.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Mapping[str, Any] | Sequence[Mapping[str, Any]],
        *,
        camera: str | int | None = None,
        look_from: Point | None = None,
        look_at: Point | None = None,
        fov: float | None = None,
        up: Point | None = None,
        spots: Spots | None = None,
        unit: str | None = None,
        root: str | os.PathLike[str] | None = None,
    ) -> None:
        view = (
            point("look_from", look_from),
            point("look_at", look_at),
            None if fov is None else float(fov),
            point("up", up),
        )
        name = None if camera is None else str(camera)
        if isinstance(source, (str, os.PathLike)):
            self._native = _native.Scene.open(source, name, view, spots, unit, root)
        elif isinstance(source, Mapping):
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder, "scene.json")
                path.write_text(json.dumps(plain(source)))
                self._native = _native.Scene.open(path, name, view, spots, unit, root)
        else:
            for argument, value in {"camera": camera, "unit": unit, "root": root}.items():
                if value is not None:
                    raise ValueError(f"{argument}: only scene files have one; meshes are in metres")
            meshes = [mesh_arrays(k, mesh) for k, mesh in enumerate(source)]
            self._native = _native.Scene.from_meshes(meshes, view, 25 if spots is None else spots)

    @classmethod
    def _of(cls, native: _native.Scene) -> Scene:
        scene = cls.__new__(cls)
        scene._native = native
        return scene

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._native.name

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image, pixels."""
        return self._native.shape

    @property
    def spots(self) -> int:
        """Number of laser beams."""
        return self._native.beams

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return self._native.triangles

    @property
    def objects(self) -> list[str]:
        """Names of the objects; `Render.instance` is the index plus one."""
        return self._native.objects

    @property
    def labels(self) -> list[str]:
        """Names of the categories; `Render.label` is the index plus one."""
        return self._native.labels

    @property
    def camera(self) -> dict[str, Any]:
        """`intrinsics` (pixels), `origin` (metres), and the axes `right`, `down` and `forward`."""
        return json.loads(self._native.facts())["camera"]

    @property
    def notes(self) -> dict[str, str]:
        """What was chosen for the scene and what was left out of its file."""
        return json.loads(self._native.facts())["provenance"]["notes"]

    def seen_from(
        self,
        look_from: Point,
        look_at: Point,
        *,
        fov: float | None = None,
        up: Point | None = None,
    ) -> Scene:
        """Returns the scene with a camera elsewhere. The laser stays where it is.

        Args:
            look_from: Position of the camera, metres.
            look_at: Point in the middle of the image, metres.
            fov: Width of the view, degrees; that of the camera without it.
            up: Direction that is upwards in the image; that of the camera without it.
        """
        eye, target = point("look_from", look_from), point("look_at", look_at)
        upwards = point("up", up) or tuple(-x for x in self.camera["down"])
        assert eye is not None and target is not None
        angle = None if fov is None else float(fov)
        return Scene._of(self._native.seen_from(eye, target, angle, upwards))

    def render(
        self,
        resolution: int | tuple[int, int] | None = None,
        *,
        error: float | None = None,
        samples: int = 64,
        bins: int = 637,
        gate: tuple[float, float] | None = None,
        seed: int = 0,
        max_bounces: int | None = None,
        split: bool = False,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Render:
        """Renders the scene. The same arguments give the same bits on any number of threads.

        Args:
            resolution: Width of the image in pixels, or (height, width); the scene's own without it.
            error: Render until the median error of a pixel is this share, such as 0.1.
            samples: Camera paths per pixel, if `error` is not given.
            bins: Number of time bins.
            gate: First and last optical path in metres. Without it, 38.4 mm bins from 1 m, or a
                gate that fits the scene if that would miss much of it.
            seed: Seed of the random numbers.
            max_bounces: Longest path in bounces; without it, until the gate ends.
            split: Also returns the light of two bounces and of more, with standard errors.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: An argument or the scene is unusable.
            MemoryError: The histograms do not fit into memory.
            KeyboardInterrupt: Ctrl-C was pressed. The render stops within 0.1 s.
        """
        native = self._native
        if resolution is not None:
            native = native.resized(*size(resolution, native.shape))
        limits = None
        if gate is not None:
            first, last = (float(x) for x in gate)
            if not 0 <= first < last:
                raise ValueError(f"gate: expected 0 <= first < last in metres, found {gate}")
            limits = (first, (last - first) / bins)
        made = _native.render(
            native,
            whole("samples", samples),
            None if error is None else float(error),
            whole("bins", bins),
            limits,
            whole("seed", seed),
            count("max_bounces", max_bounces),
            split,
            count("threads", threads),
            watcher(progress, "rendering"),
        )
        if progress is True:
            print(file=sys.stderr)
        facts = json.loads(made.pop("facts"))
        return Render(scene=Scene._of(native), gate=Gate(**facts.pop("gate")), facts=facts, **made)

    def __repr__(self) -> str:
        height, width = self.shape
        return (
            f"<picofarm.Scene {self.name!r}: {self.triangles} triangles, {self.spots} spots, "
            f"{width}x{height} pixels>"
        )


def furnished(
    seed: int,
    *,
    resolution: int = 256,
    spots: Spots = 25,
    fov: float = 90.0,
    mirrors: int = 0,
    assets: str = "parametric",
    floor_plan: str = "box",
) -> Scene:
    """Returns the furnished room of a seed: the same room on every machine.

    Args:
        resolution: Width and height of the image, pixels.
        spots: See `Scene`.
        fov: Width of the view, degrees.
        mirrors: Least number of mirrors in view, 0 to 4.
        assets: Library of furniture: `parametric` or `sweethome3d`.
        floor_plan: `box`, or `varied` for L-shaped rooms, open doors and glazed windows.
    """
    side = whole("resolution", resolution)
    least = whole("mirrors", mirrors)
    seed = whole("seed", seed)
    room = (assets, floor_plan)
    return Scene._of(_native.Scene.furnished(seed, side, spots, float(fov), least, room))
