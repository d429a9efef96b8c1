"""The part of the package that is written in Rust. Use the classes of `picofarm` instead."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__version__: str

_Point = tuple[float, float, float]
_View = tuple[_Point | None, _Point | None, float | None, _Point | None]
_Mesh = tuple[NDArray[np.float32], NDArray[np.uint32], _Point, float | None]
_Spots = int | str | Sequence[tuple[float, float]]

def main(python: str, arguments: Sequence[str]) -> int: ...
def render(
    scene: Scene,
    samples: int,
    error: float | None,
    bins: int,
    gate: tuple[float, float] | None,
    seed: int,
    max_bounces: int | None,
    split: bool,
    threads: int | None,
    progress: Callable[[float], object] | None,
) -> dict[str, Any]: ...
def demultiplex(
    histogram: NDArray[np.float32],
    view: Viewpoint,
    gate: tuple[float, float],
    spots: NDArray[np.float32],
    shadows: str,
    threads: int | None,
) -> dict[str, Any]: ...
def reconstruct(
    histogram: NDArray[np.float32],
    view: Viewpoint,
    scene: Scene | None,
    gate: tuple[float, float],
    spots: NDArray[np.float32],
    nodes: int | None,
    seed: int,
    threads: int | None,
    progress: Callable[[float], object] | None,
) -> dict[str, Any]: ...
def sense(
    histogram: NDArray[np.float32],
    two: NDArray[np.float32] | None,
    start_m: float,
    bin_width_m: float,
    sensor: str,
    seed: int,
    scene: int,
    threads: int | None,
) -> dict[str, Any]: ...

class Viewpoint:
    def __new__(
        cls,
        intrinsics: tuple[float, float, float, float],
        shape: tuple[int, int],
        laser: _Point,
    ) -> Viewpoint: ...
    @staticmethod
    def of_scene(scene: Scene) -> Viewpoint: ...

class Scene:
    @staticmethod
    def open(
        path: str | os.PathLike[str],
        camera: str | None,
        view: _View,
        spots: _Spots | None,
        unit: str | None,
        root: str | os.PathLike[str] | None,
    ) -> Scene: ...
    @staticmethod
    def furnished(
        seed: int,
        resolution: int,
        spots: _Spots,
        fov: float,
        mirrors: int,
        room: tuple[str, str],
    ) -> Scene: ...
    @staticmethod
    def from_meshes(meshes: Sequence[_Mesh], view: _View, spots: _Spots) -> Scene: ...
    def seen_from(
        self, look_from: _Point, look_at: _Point, fov: float | None, up: _Point
    ) -> Scene: ...
    def resized(self, height: int, width: int) -> Scene: ...
    @property
    def name(self) -> str: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def triangles(self) -> int: ...
    @property
    def beams(self) -> int: ...
    @property
    def objects(self) -> list[str]: ...
    @property
    def labels(self) -> list[str]: ...
    def facts(self) -> str: ...

class Model:
    def __new__(cls, store: str, name: str) -> Model: ...
    def manifest(self) -> str: ...
    def predict(
        self,
        histogram: NDArray[np.float32],
        depth: NDArray[np.float32] | None,
        spots: NDArray[np.float32] | None,
        intrinsics: Sequence[float] | None,
        threads: int | None,
    ) -> NDArray[np.float32]: ...

class Dataset:
    def __new__(
        cls, url: str, threads: int | None, cache: tuple[str, int] | None
    ) -> Dataset: ...
    def cache_trouble(self) -> str | None: ...
    def facts(self) -> str: ...
    def scenes(self) -> list[int]: ...
    def split(self, name: str, version: int | None) -> tuple[int, bytes]: ...
    def manifest(self, scene: int) -> str: ...
    def read(
        self,
        scene: int,
        array: str,
    ) -> NDArray[Any]: ...
    def read_bins(
        self,
        scene: int,
        array: str,
        ranges: tuple[tuple[int, int], tuple[int, int], tuple[int, int]],
        target: NDArray[np.float32],
    ) -> None: ...
