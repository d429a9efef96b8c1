"""Writes the scenes of a picofarm data set as HDF5 files or as tar files for WebDataset: convert.py DATASET FOLDER hdf5|tar

Needs what transients.py needs, and h5py for HDF5. A scene's arrays are those that transients.py reads.
"""

import io
import pathlib
import sys
import tarfile

import numpy
from transients import Transients

SCENES_A_TAR = 8


def hdf5(scenes, folder):
    import h5py

    for index in range(len(scenes)):
        scene = scenes[index]
        with h5py.File(folder / f"{scene['scene']:06}.h5", "w") as file:
            for name, values in scene.items():
                if numpy.ndim(values):
                    file.create_dataset(name, data=values, compression="gzip", shuffle=True)
                else:
                    file.attrs[name] = values


def tar(scenes, folder):
    for first in range(0, len(scenes), SCENES_A_TAR):
        with tarfile.open(folder / f"scenes-{first // SCENES_A_TAR:06}.tar", "w") as file:
            for index in range(first, min(first + SCENES_A_TAR, len(scenes))):
                scene = scenes[index]
                arrays = io.BytesIO()
                numpy.savez_compressed(arrays, **scene)
                entry = tarfile.TarInfo(f"{scene['scene']:06}.npz")
                entry.size = arrays.tell()
                arrays.seek(0)
                file.addfile(entry, arrays)


if __name__ == "__main__":
    location, folder, form = sys.argv[1:]
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    {"hdf5": hdf5, "tar": tar}[form](Transients(location), folder)
