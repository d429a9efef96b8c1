"""Data sets, read by the module and by zarr."""

import multiprocessing
import pathlib
import pickle

import numpy as np
import pytest

import picofarm


def test_arrays_are_those_of_zarr(dataset: str) -> None:
    zarr = pytest.importorskip("zarr")
    data = picofarm.open(dataset)
    group = zarr.open_group(dataset, mode="r")
    assert len(data) > 1
    for scene in data:
        index = scene["scene"]
        assert np.array_equal(scene["depth"], group["depth"][index])
        stored = np.moveaxis(group["transient"][index], 0, -1)
        coding = group["transient"].attrs
        expected = stored
        exact = np.ones(stored.shape, bool)
        if "delta" in coding:
            code = stored.astype("float32")
            expected = (code * np.float32(coding["delta"] / 2)) ** 2 / scene["scale"]
            # The manifest has the values of bins that the code cannot hold.
            exact = stored != coding["saturated_code"]
        assert np.allclose(scene["transient"][exact], expected[exact], rtol=1e-5)
        assert np.all(scene["transient"][~exact] > 0)
        assert scene["visibility"].shape == (data.spots, *data.shape)


def test_crops_and_bins_are_parts_of_the_whole(dataset: str) -> None:
    whole = picofarm.open(dataset)[0]
    part = picofarm.open(dataset, crop=(3, 5, 8, 9), bins=(10, 40))[0]
    assert np.array_equal(part["transient"], whole["transient"][3:11, 5:14, 10:40])
    for name in ("depth", "specular", "intensity"):
        assert np.array_equal(part[name], whole[name][3:11, 5:14])
    assert np.array_equal(part["visibility"], whole["visibility"][:, 3:11, 5:14])
    assert np.allclose(part["intrinsics"] - whole["intrinsics"], [0, 0, -5, -3])


def test_a_copy_in_another_process_reads_the_same(dataset: str) -> None:
    data = picofarm.open(dataset, arrays=["transient", "depth"], bins=(0, 50))
    expected = data[1]["transient"]
    assert np.array_equal(pickle.loads(pickle.dumps(data))[1]["transient"], expected)
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(2) as pool:
            scenes = pool.map(data.__getitem__, [1, 1, 1])
        assert all(np.array_equal(scene["transient"], expected) for scene in scenes)


def test_unusable_arguments_are_refused_by_name(dataset: str) -> None:
    with pytest.raises(ValueError, match="arrays: .*photons"):
        picofarm.open(dataset, arrays=["photons"])
    with pytest.raises(ValueError, match="crop: "):
        picofarm.open(dataset, crop=(0, 0, 10_000, 1))
    with pytest.raises(ValueError, match="bins: "):
        picofarm.open(dataset, bins=(5, 5))
    with pytest.raises(ValueError, match="split_name: .*dataset split"):
        picofarm.open(dataset, split="train", split_name="absent")
    with pytest.raises(ValueError, match="split: .*validation"):
        picofarm.open(dataset, split="dev")
    with pytest.raises(ValueError, match="split or scenes|not both"):
        picofarm.open(dataset, split="train", scenes=[0])
    with pytest.raises(KeyError, match="99999"):
        picofarm.open(dataset).read(99999)
    with pytest.raises(FileNotFoundError):
        picofarm.open(dataset + "-absent")


def test_flipped_bytes_are_noticed(dataset: str, tmp_path: pathlib.Path) -> None:
    import shutil

    copy = tmp_path / "rooms"
    shutil.copytree(dataset, copy)
    files = (path for path in sorted((copy / "transient").rglob("*")) if path.is_file())
    file = next(path for path in files if path.name != "zarr.json")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(OSError, match="transient"):
        for _ in picofarm.open(str(copy)):
            pass


def test_a_cache_keeps_what_was_read(dataset: str, tmp_path: pathlib.Path) -> None:
    import shutil

    copy, cache = tmp_path / "rooms", tmp_path / "cache"
    shutil.copytree(dataset, copy)
    data = picofarm.open(copy, arrays=["transient", "depth"], cache=cache)
    crop = {"crop": (0, 0, 8, 8), "bins": (3, 9)}
    first = [(data[k], data.read(data.scenes[k], **crop)) for k in range(2)]
    for array in ("transient", "depth"):
        shutil.rmtree(copy / array / "c")
    again = pickle.loads(pickle.dumps(data))
    for k, scenes in enumerate(first):
        for scene, other in zip(scenes, (again[k], again.read(data.scenes[k], **crop)), strict=True):
            assert np.array_equal(scene["transient"], other["transient"])
            assert np.array_equal(scene["depth"], other["depth"])
    with pytest.raises(OSError, match="missing"):
        picofarm.open(copy)[0]


def test_a_cache_that_cannot_be_written_warns_and_reads(
    dataset: str, tmp_path: pathlib.Path
) -> None:
    cache = tmp_path / "cache"
    data = picofarm.open(dataset, arrays=["depth"], cache=cache)
    cache.rmdir()
    cache.write_text("a file")
    with pytest.warns(UserWarning, match="cannot write to the cache"):
        scene = data[0]
    assert np.array_equal(scene["depth"], picofarm.open(dataset)[0]["depth"])
    with pytest.raises(OSError, match="cache"):
        picofarm.open(dataset, cache=cache)
    with pytest.raises(ValueError, match="cache_bytes"):
        picofarm.open(dataset, cache=tmp_path / "other", cache_bytes=0)


def test_a_stream_reads_each_scene_once_an_epoch_in_an_order_of_its_own(dataset: str) -> None:
    data = picofarm.open(dataset, arrays=["depth"], threads=1)
    stream = data.stream(seed=3, ahead=2)
    epochs = [[scene["scene"] for scene in stream] for _ in range(6)]
    assert all(sorted(epoch) == data.scenes for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1
    assert epochs[2] == data.stream(seed=3, epoch=2).order()
    assert data.stream(seed=None).order() == data.scenes


def test_ranks_and_workers_share_the_scenes_without_overlap(dataset: str) -> None:
    data = picofarm.open(dataset, arrays=["depth"])
    parts = [data.stream(seed=1, rank=rank, ranks=2) for rank in range(2)]
    assert len(parts[0]) == len(parts[1]) == len(data) // 2
    read = [scene for part in parts for scene in part.order()]
    assert len(set(read)) == len(read)
    whole = parts[0].order()
    shares = []
    for worker in range(2):
        parts[0].share_among_workers(worker, 2)
        shares += parts[0].order()
    assert sorted(shares) == sorted(whole)


def test_a_stream_continues_at_its_position(dataset: str) -> None:
    data = picofarm.open(dataset, arrays=["transient", "depth"])
    stream = data.stream(seed=5, crop=8)
    expected = [(scene["scene"], scene["transient"].sum()) for scene in stream]
    stream = data.stream(seed=5, crop=8)
    first = next(iter(stream))
    assert first["transient"].shape == (8, 8, data.gate.bins)
    copy = data.stream(seed=5, crop=8)
    copy.load_state_dict(stream.state_dict())
    rest = [(scene["scene"], scene["transient"].sum()) for scene in copy]
    assert [(first["scene"], first["transient"].sum()), *rest] == expected
    rest = [scene["scene"] for scene in pickle.loads(pickle.dumps(stream))]
    assert rest == [scene for scene, _ in expected[1:]]


def test_a_scene_becomes_an_xarray_with_units(dataset: str) -> None:
    pytest.importorskip("xarray")
    data = picofarm.open(dataset, bins=(10, 30))
    scene = data.to_xarray(1)
    assert scene["transient"].dims == ("row", "column", "bin")
    assert np.allclose(scene["path"], data.gate.paths_m[10:30])
    assert scene["depth"].attrs["units"] == "m"
    assert scene.attrs["scene"] == 1


def test_unusable_streams_are_refused_by_name(dataset: str) -> None:
    data = picofarm.open(dataset)
    for name, value in {"rank": 1, "crop": 10_000, "ahead": 0, "seed": -1}.items():
        with pytest.raises(ValueError, match=f"{name}: "):
            data.stream(**{name: value})
