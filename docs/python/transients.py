"""Scenes of a picofarm data set for training: needs numpy and zarr >= 3.1, and obstore for s3:// and other URLs.

    scenes = Transients("s3://bucket/rooms", split="train", bins=(0, 256))
    scenes[0]["transient"]  # float32 [row][column][bin]

An example to copy and change; docs/python.md explains it.
"""

import atexit
import json
import os
import pathlib
import time

import numpy
import zarr


class Place:
    """The folder or object store prefix in which a data set lies. Credentials come from the environment."""

    def __init__(self, location):
        self.location = os.fspath(location)
        self.remote = "://" in self.location and not self.location.startswith("file://")
        if self.remote:
            import obstore  # pip install obstore

            # Its threads may still let go of what was read while the interpreter ends, which then crashes after all is done
            # (https://github.com/PyO3/pyo3-async-runtimes/issues/40): a moment for them.
            atexit.register(time.sleep, 0.2)
            self.obstore = obstore
            self.objects = obstore.store.from_url(self.location)
        else:
            self.folder = pathlib.Path(self.location.removeprefix("file://"))

    def zarr_store(self):
        if self.remote:
            return zarr.storage.ObjectStore(self.objects, read_only=True)
        return zarr.storage.LocalStore(self.folder, read_only=True)

    def json(self, key):
        try:
            if self.remote:
                return json.loads(self.objects.get(key).bytes().to_bytes())
            return json.loads((self.folder / key).read_bytes())
        except FileNotFoundError:
            raise FileNotFoundError(f"{self.location}: there is no {key}") from None

    def numbers(self, folder, before, after):
        """Sorted numbers n of the objects folder/<before>n<after>."""
        if self.remote:
            listed = (meta["path"] for page in self.objects.list(prefix=folder) for meta in page)
        else:
            listed = (path.name for path in (self.folder / folder).glob(f"{before}*{after}"))
        names = (path.rsplit("/", 1)[-1] for path in listed)
        names = (n.removeprefix(before).removesuffix(after) for n in names if n.startswith(before) and n.endswith(after))
        return sorted(int(n) for n in names if n.isdigit())


ARRAYS = ("transient", "depth", "visibility", "specular", "intensity", "spots", "intrinsics")


class Transients:
    """The scenes of a data set, as a map-style data set of PyTorch or without it.

    scenes     indices; without them and without a split all that are published
    split      "train", "validation" or "test" of the split that `picofarm dataset split` recorded
    split_name, split_version   which split; its newest version if none is named
    histogram  "transient", or "transient_4", "transient_25", "transient_spots" where the data set has them
    crop       (row, column, height, width) in pixels; the intrinsics are shifted with it
    bins       (first, end); all without it
    arrays     what to read of each scene, beside its index and `scale` (photons per unit of the histogram):
               transient    float32 [row][column][bin]; [spot][row][column][bin] of transient_spots
               depth        float32 [row][column], z-depth in metres, 0 = nothing there
               visibility   uint8 [spot][row][column], 1 = the spot lights what the pixel sees
               specular     uint8 [row][column], 1 = a mirror
               intensity    float32 [row][column], the histogram's sum over all bins
               spots        float32 [spot][x, y, z, nx, ny, nz, path from the laser], camera frame, NaN = no spot
               intrinsics   float32 [fx, fy, cx, cy] in pixels of the crop
    """

    def __init__(self, location, scenes=None, split=None, split_name="default", split_version=None,
                 histogram="transient", crop=None, bins=None, arrays=ARRAYS):
        if scenes is not None and split is not None:
            raise ValueError("give scenes or split, not both")
        if unknown := set(arrays) - set(ARRAYS):
            raise ValueError(f"arrays: {sorted(unknown)} are not among {ARRAYS}")
        self.location, self.histogram, self.arrays = os.fspath(location), histogram, tuple(arrays)
        self.crop, self.bins = crop, bins
        self._opened = None
        if split is not None:
            scenes = self._split(split, split_name, split_version)
        elif scenes is None:
            scenes = self._open()[0].numbers("manifests", "", ".json")
        self.scenes = numpy.asarray(scenes, dtype="int64")

    def __len__(self):
        return len(self.scenes)

    def __getitem__(self, index):
        return self.read(int(self.scenes[index]))

    def read(self, scene, crop=None, bins=None):
        """A scene by its index in the data set: a dict of arrays. Crop and bins as above, for this read alone."""
        place, group = self._open()
        rows, columns = self._pixels(group, crop or self.crop)
        scale = group["scale"][scene]
        if not numpy.isfinite(scale):
            raise KeyError(f"{self.location}: scene {scene} is not published")
        self._check_known(place, scene)
        pixels = {name: (lambda name=name: group[name][scene, rows, columns]) for name in ("depth", "intensity", "specular")}
        make = pixels | {
            "transient": lambda: self._decode(place, group, scene, scale, rows, columns, bins or self.bins),
            "visibility": lambda: self._lit(group["visibility"], scene, rows, columns),
            "spots": lambda: group["spots"][scene],
            "intrinsics": lambda: group["intrinsics"][scene] - numpy.array([0, 0, columns.start, rows.start], "float32"),
        }
        return {"scene": scene, "scale": scale} | {name: make[name]() for name in self.arrays}

    def _check_known(self, place, scene):
        """Imports may lack some of the truth; what is stored in its place stands for nothing."""
        missing = place.json(f"manifests/{scene}.json")["provenance"]["plan"].get("missing", [])
        lacking = [name for name in self.arrays if name in missing]
        if lacking:
            raise ValueError(f"{self.location}: scene {scene} was imported without {', '.join(lacking)}: leave them out of arrays")

    def _lit(self, array, scene, rows, columns):
        bits = array[scene, :, rows, columns]
        return numpy.unpackbits(bits, axis=0, bitorder="little", count=array.attrs["spots"])

    def _decode(self, place, group, scene, scale, rows, columns, bins):
        """h as float32. How it is coded stands in the array's attributes."""
        array = group[self.histogram]
        coding = array.attrs
        first, end = bins or (0, array.shape[-1])
        if not 0 <= first < end <= array.shape[-1]:
            raise ValueError(f"bins {(first, end)}: expected first < end within 0 to {array.shape[-1]}")
        stored = array[scene, ..., rows, columns, first:end]
        if "delta" in coding:  # square-root code
            h = stored.astype("float32")
            h *= numpy.float32(coding["delta"] / 2)
            h *= h
            h /= scale
        elif coding.get("units") == "photons":
            h = stored.astype("float32")
            h /= scale
        elif stored.dtype == numpy.float32:
            return stored
        else:
            raise ValueError(f"{self.location}: {self.histogram} is coded in a way that this reader does not know")
        saturated = stored == coding["saturated_code"]
        if saturated.any():
            self._fill(place, scene, array.shape[1:], h, saturated, rows, columns, first)
        return h

    def _fill(self, place, scene, shape, h, saturated, rows, columns, first):
        """Puts the exact values of saturated bins in their places."""
        manifest = place.json(f"manifests/{scene}.json")
        if self.histogram != "transient":
            manifest = manifest["subsets"][self.histogram]
        flat, exact = zip(*manifest["overflow"]) if manifest["overflow"] else ((), ())
        at = numpy.array(numpy.unravel_index(numpy.array(flat, dtype="int64"), shape))
        at[-3:] -= numpy.array([[rows.start], [columns.start], [first]])
        inside = ((at >= 0) & (at < numpy.array(h.shape)[:, None])).all(axis=0)
        at = tuple(at[:, inside])
        h[at] = numpy.array(exact, dtype="float32")[inside]
        saturated[at] = False
        if saturated.any():
            raise ValueError(f"{self.location}: scene {scene} has saturated bins without exact values: run picofarm dataset verify")

    def _pixels(self, group, crop):
        _, height, width = group["depth"].shape
        row, column, h, w = crop or (0, 0, height, width)
        if row < 0 or column < 0 or h < 1 or w < 1 or row + h > height or column + w > width:
            raise ValueError(f"crop {crop}: expected (row, column, height, width) within {height}x{width} pixels")
        return slice(row, row + h), slice(column, column + w)

    def _split(self, side, name, version):
        sides = ("train", "validation", "test")
        if side not in sides:
            raise ValueError(f"split {side!r}: expected one of {sides}")
        place, _ = self._open()
        versions = place.numbers(f"splits/{name}", "v", ".json")
        if not versions:
            raise FileNotFoundError(f"{self.location}: no split {name!r}; make it with picofarm dataset split")
        record = place.json(f"splits/{name}/v{version or versions[-1]}.json")
        return numpy.flatnonzero(numpy.frombuffer(record["sides"].encode(), "uint8") == ord(str(sides.index(side))))

    def _open(self):
        """Opened on first use in each process: neither threads nor connections cross from one to another."""
        if self._opened is None:
            place = Place(self.location)
            self._opened = os.getpid(), place, zarr.open_group(place.zarr_store(), mode="r", zarr_format=3)
        process, place, group = self._opened
        if process != os.getpid():
            raise RuntimeError("this process is a fork: start workers with multiprocessing_context='spawn'")
        return place, group

    def __getstate__(self):
        return self.__dict__ | {"_opened": None}
