"""Compares an export as tar or HDF5 files with the data set it was made from, by numpy, h5py and xarray alone, and checks
what its card, table and Croissant metadata say.

usage: read_files.py DATASET EXPORT

Exits non-zero at the first difference.
"""

import csv
import hashlib
import io
import json
import pathlib
import sys
import tarfile

import h5py
import numpy as np
import xarray as xr


def samples(export):
    """Scene, arrays and manifest of each."""
    for path in sorted(export.glob("*.h5")):
        with h5py.File(path) as f:
            assert f["transient"].chunks and f["transient"].compression == "gzip" and f["transient"].shuffle
            assert b"radiance" in f["transient"].attrs["long_name"], dict(f["transient"].attrs)
            yield int(f.attrs["scene"]), {k: v[()] for k, v in f.items() if k != "manifest"}, json.loads(f["manifest"].asstr()[0])
    for path in sorted(export.glob("scenes-*.tar")):
        with tarfile.open(path) as tar:
            # As WebDataset groups them: files of one base name, one after the other.
            names = tar.getnames()
            for npz, aside in zip(names[::2], names[1::2]):
                assert npz.split(".")[0] == aside.split(".")[0], (npz, aside)
                arrays = np.load(io.BytesIO(tar.extractfile(npz).read()))
                aside = json.load(tar.extractfile(aside))
                yield aside["scene"], {k: arrays[k] for k in arrays.files}, aside["manifest"]


def main(dataset, export):
    export = pathlib.Path(export)
    source = xr.open_zarr(dataset)
    rows = list(csv.DictReader((export / "scenes.csv").open()))
    found = []
    for scene, arrays, manifest in samples(export):
        found.append(scene)
        values = {"xarray": xr, "numpy": np, "location": dataset, "i": scene}
        exec("\n".join(source.attrs["decode"]), values)
        h = values["h"].copy()
        for at, exact in manifest["overflow"]:
            h.reshape(-1)[at] = exact
        np.testing.assert_allclose(arrays["transient"], np.moveaxis(h, 0, -1), rtol=1e-6)
        assert arrays["transient"].dtype == np.float32 and arrays["transient"].ndim == 3
        np.testing.assert_array_equal(arrays["visibility"], values["lit"])
        for name in ["depth", "range", "instance", "label", "specular", "rgb", "spots", "intrinsics", "camera", "laser"]:
            np.testing.assert_array_equal(arrays[name], source[name][scene].values, err_msg=name)
        np.testing.assert_allclose(arrays["normal"], source["normal"][scene].values, rtol=1e-6, atol=1e-7)
        assert arrays["photons_per_unit"].reshape(()) == source["scale"][scene].values
        row = rows[len(found) - 1]
        assert (row["index"], row["source_scene"]) == (str(len(found) - 1), str(scene)), row
        assert (export / row["file"]).is_file() and row["task_key"] == manifest["provenance"]["task_key"]
        assert np.float32(row["photons_per_unit"]) == np.float32(manifest["scale"])
    assert found and len(found) == len(rows), (len(found), len(rows))

    croissant = json.loads((export / "croissant.json").read_text())
    table = (export / "scenes.csv").read_bytes()
    assert croissant["distribution"][0]["sha256"] == hashlib.sha256(table).hexdigest()
    columns = [f["source"]["extract"]["column"] for f in croissant["recordSet"][0]["field"]]
    assert columns == list(rows[0]), columns
    assert any(export.glob(croissant["distribution"][1]["includes"]))
    card = (export / "README.md").read_text()
    assert card.startswith("---\n") and "data_files: scenes.csv" in card.split("---")[1]
    for name in source.data_vars:
        assert f"`{name}`" in card, name
    print(f"{len(found)} scenes equal")


if __name__ == "__main__":
    main(*sys.argv[1:])
