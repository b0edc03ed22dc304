"""LeRobot datasets: written for both layouts, read back here and, opt in, by the ``lerobot`` package itself."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from tiptrace.config import Rig, load_yaml
from tiptrace.errors import ConfigError, OutputError, RecordingError
from tiptrace.export.dataset import LeRobotOptions, export_dataset
from tiptrace.export.episodes import Episode, Source, find_sources, load_episode, traced_episode
from tiptrace.export.images import EncodedImages
from tiptrace.export.lerobot_annotate import annotate
from tiptrace.export.lerobot_format import PHASE, TIP_FEATURES, Feature, pooled, stats_of
from tiptrace.export.lerobot_reader import LeRobotStream, open_lerobot
from tiptrace.export.lerobot_writer import LikeTheFirst, write_lerobot
from tiptrace.sim.spec import make_spec
from tiptrace.streams.simulated import SimulatedStream
from tiptrace.streams.writer import write_recording
from tiptrace.types import SIDES, Image, Side, Status, TipEstimate

SHORT = {"mode": "markers", "travel_m": 0.011, "fps": 25.0, "anchoring_s": 1.4}
READER = Path(__file__).with_name("lerobot_read.py")


def simulated(folder: Path, count: int) -> Path:
    for seed in range(count):
        stream = SimulatedStream(make_spec(seed=seed, trajectory=f"T{seed % 5 + 1}", **SHORT))
        write_recording(folder / f"t{seed:02d}.mcap", stream, trial=stream.trial_metadata)
    return folder


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("recordings"), 2)


def sources_of(folder: Path) -> list[Source]:
    return find_sources([folder])[0]


def made_up(n: int, images: bool = False) -> Episode:
    stamps = 10**18 + 40_000_000 * np.arange(n)[:, None] + np.array([0, -1, 1])
    estimates = [TipEstimate(int(s), None, Status.OK, p_B=np.full(3, k)) for k, s in enumerate(stamps[:, 0])]
    episode = Episode.of("x", "full", stamps, estimates)
    pictures: dict[Side, EncodedImages] = {}
    for side in ("left", "right") if images else ():
        pictures[side] = EncodedImages()
        for k in range(n):
            pictures[side].append(np.full((24, 32, 3), (k, 100, 200), dtype=np.uint8))
    return Episode(**{f: getattr(episode, f) for f in Episode.__slots__} | {"images": pictures})


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_dataset_holds_what_the_tracer_said(recordings: Path, tmp_path: Path, version: str):
    out = tmp_path / "tip"
    done = export_dataset(sources_of(recordings), "lerobot", out, lerobot=LeRobotOptions(version))
    assert not done.failures
    info = json.loads((out / "meta/info.json").read_text())
    episodes = [load_episode(s, "full") for s in sources_of(recordings)]
    assert info["codebase_version"] == version
    assert (info["total_episodes"], info["total_frames"]) == (2, sum(map(len, episodes)))
    tables = [pq.read_table(f) for f in sorted((out / "data").rglob("*.parquet"))]
    rows = [row for table in tables for row in table.to_pylist()]
    for name, expected in (
        ("observation.tip.position", np.concatenate([e.position for e in episodes])),
        ("observation.tip.covariance", np.concatenate([e.covariance.reshape(-1, 9) for e in episodes])),
        ("observation.state", np.concatenate([e.state for e in episodes if e.state is not None])),
    ):
        found = np.array([r[name] for r in rows], dtype=np.float32)
        np.testing.assert_array_equal(found, expected.astype(np.float32))
    assert [r["frame.stamp_ns"] for r in rows] == [int(s) for e in episodes for s in e.stamps[:, 0]]
    assert [r["index"] for r in rows] == list(range(len(rows)))
    assert json.loads((out / "meta/tiptrace.json").read_text())["estimates"] == "causal"


def test_images_go_along_compressed(tmp_path: Path):
    write_lerobot(tmp_path, [made_up(30, images=True)])
    (file,) = (tmp_path / "data").rglob("*.parquet")
    column = pq.read_table(file)["observation.images.tactile_left"].to_pylist()
    image = cv2.imdecode(np.frombuffer(column[7]["bytes"], np.uint8), cv2.IMREAD_COLOR)
    assert abs(image.astype(float) - (7, 100, 200)).max() <= 3
    stats = json.loads((tmp_path / "meta/stats.json").read_text())["observation.images.tactile_left"]
    assert np.shape(stats["mean"]) == (3, 1, 1)
    assert np.ravel(stats["mean"]) == pytest.approx([200 / 255, 100 / 255, 10 / 255])


def test_statistics_leave_unknown_rows_out_and_add_up():
    feature = {"x": Feature("float32", (2,))}
    a, b = np.array([[0.0, 1], [2, 3], [np.nan, np.nan]]), np.array([[4.0, 5]])
    both = pooled([stats_of(feature, {"x": a}), stats_of(feature, {"x": b})])["x"]
    known = np.array([[0.0, 1], [2, 3], [4, 5]])
    assert both["count"] == [3]
    assert both["mean"] == pytest.approx(known.mean(axis=0))
    assert both["std"] == pytest.approx(known.std(axis=0))
    assert (both["min"], both["max"]) == ([0, 1], [4, 5])
    nothing = stats_of(feature, {"x": a[2:]})["x"]
    assert nothing["count"] == [0]
    assert np.isfinite(nothing["mean"]).all()


def test_lerobot_never_divides_by_the_count_of_a_column_without_values(tmp_path: Path):
    write_lerobot(tmp_path, [made_up(5)], "v2.1")  # no covariance anywhere
    (line,) = (tmp_path / "meta/episodes_stats.jsonl").read_text().splitlines()
    assert all(s["count"][0] > 0 for s in json.loads(line)["stats"].values())


def test_an_episode_unlike_the_first_is_refused():
    check = LikeTheFirst()
    check(made_up(5))
    with pytest.raises(OutputError, match="tactile_left"):
        check(made_up(5, images=True))
    with pytest.raises(OutputError, match="fewer than two frames"):
        check(made_up(1))


def test_an_unknown_version_is_refused_before_anything_is_traced(recordings: Path, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"v3\.0, v2\.1"):
        export_dataset(sources_of(recordings), "lerobot", tmp_path / "x", lerobot=LeRobotOptions("v1.6"))


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Episode, Path]:
    """A short trial with images, and a folder with its rig file and references."""
    settings = {
        "travel_m": 0.004,
        "fps": 10.0,
        "anchoring_s": 1.6,
        "mode": "images",
        "level": "clean",
        "seed": 5,
    }
    stream = SimulatedStream(make_spec(**settings))
    episode = traced_episode("x", stream, "paper", images=True)
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.yaml").write_text(yaml.safe_dump(stream.rig.model_dump(mode="json", exclude_none=True)))
    for side, image in stream.references.items():
        cv2.imwrite(str(folder / f"{side}.png"), image)
    return episode, folder


def theirs(
    folder: Path, episode: Episode, version: str = "v3.0", tactile: bool = True, first: Episode | None = None
) -> Path:
    """A dataset as others have it, of two episodes: poses and tactile images without any tip."""
    write_lerobot(folder, [first or episode, episode], version)
    info = json.loads((folder / "meta/info.json").read_text())
    gone = [n for n in info["features"] if n.startswith("observation.tip.") and n != PHASE]
    gone += [] if tactile else [n for n in info["features"] if "tactile" in n]
    for file in (folder / "data").rglob("*.parquet"):
        pq.write_table(pq.read_table(file).drop_columns(gone).replace_schema_metadata(None), file)
    info["features"] = {n: f for n, f in info["features"].items() if n not in gone}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_dataset_is_annotated_at_its_own_frames(
    pictured: tuple[Episode, Path], tmp_path: Path, version: str
):
    episode, folder = pictured
    root, rig = theirs(tmp_path / "theirs", episode, version), folder / "rig.yaml"
    before = [pq.read_table(f) for f in sorted((root / "data").rglob("*.parquet"))]
    untouched: dict[Side, Path] = {side: folder / f"{side}.png" for side in SIDES}
    done = annotate(open_lerobot(root), tmp_path / "ours", rig, None, untouched, method="paper")
    assert not done.failures
    files = sorted((tmp_path / "ours/data").rglob("*.parquet"))
    after = [pq.read_table(f) for f in files]
    for old, new in zip(before, after, strict=True):
        assert new.select(old.column_names).equals(old)
    rows = [row for table in after for row in table.to_pylist()]
    valid = np.array([r["observation.tip.valid"] for r in rows])
    assert np.isfinite(episode.position).all(axis=1).sum() * 2 == pytest.approx(valid.sum(), abs=4)
    position = np.array([r["observation.tip.position"] for r in rows])
    assert len(rows) == json.loads((root / "meta/info.json").read_text())["total_frames"]
    assert valid.mean() > 0.5
    assert np.isfinite(position[valid]).all()
    half = len(rows) // 2
    np.testing.assert_array_equal(position[:half], position[half:])  # the same episode twice
    assert set(TIP_FEATURES) <= set(json.loads((tmp_path / "ours/meta/info.json").read_text())["features"])
    with pytest.raises(ConfigError, match="already"):
        annotate(open_lerobot(tmp_path / "ours"), tmp_path / "again", rig)


def filmed(root: Path, version: str, frames: int) -> Path:
    """The same dataset of two episodes with its tactile images as videos, as LeRobot itself keeps them."""
    info = json.loads((root / "meta/info.json").read_text())
    keys = [n for n in info["features"] if "tactile" in n]
    tables = [pq.read_table(f) for f in sorted((root / "data").rglob("*.parquet"))]
    layout = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    if version == "v2.1":
        layout = "chunk-{episode_chunk:03d}/episode_{episode_index:06d}"
    info["video_path"] = f"videos/{{video_key}}/{layout}.mp4"
    for key in keys:
        info["features"][key]["dtype"] = "video"
        cells = [cell["bytes"] for table in tables for cell in table[key].to_pylist()]
        images = [cv2.imdecode(np.frombuffer(c, np.uint8), cv2.IMREAD_COLOR) for c in cells]
        parts = [images] if version == "v3.0" else [images[:frames], images[frames:]]
        for k, part in enumerate(parts):
            place = {"chunk_index": 0, "file_index": 0, "episode_chunk": 0, "episode_index": k}
            path = root / info["video_path"].format(video_key=key, **place)
            path.parent.mkdir(parents=True, exist_ok=True)
            film(path, part, round(info["fps"]))
    for file, table in zip(sorted((root / "data").rglob("*.parquet")), tables, strict=True):
        pq.write_table(table.drop_columns(keys).replace_schema_metadata(None), file)
    if version == "v3.0":
        (file,) = (root / "meta/episodes").rglob("*.parquet")
        table = pq.read_table(file)
        for key in keys:
            for name, values in (("chunk_index", [0, 0]), ("file_index", [0, 0])):
                table = table.append_column(f"videos/{key}/{name}", pa.array(values))
            begins = pa.array([0.0, frames / info["fps"]])
            table = table.append_column(f"videos/{key}/from_timestamp", begins)
        pq.write_table(table, file)
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def backwards(images: EncodedImages) -> EncodedImages:
    turned = EncodedImages()
    for data in reversed(images.encoded):
        turned.append(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    return turned


def film(path: Path, images: list[Image], fps: int) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=fps)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 20_000_000
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_dataset_with_videos_is_read_frame_by_frame_and_annotated(
    pictured: tuple[Episode, Path], tmp_path: Path, version: str
):
    episode, folder = pictured
    first = replace(episode, images={side: backwards(i) for side, i in episode.images.items()})
    source = open_lerobot(theirs(tmp_path / "images", episode, version, first=first))
    root = theirs(tmp_path / "videos", episode, version, first=first)
    films = open_lerobot(filmed(root, version, len(episode.position)))
    rig = load_yaml(Rig, folder / "rig.yaml")
    for index in (0, 1):
        for side in SIDES:
            still = list(LeRobotStream(source, index, rig).images(side))
            moving = list(LeRobotStream(films, index, rig).images(side))
            assert len(still) == len(moving)
            off = np.array([[np.abs(a.astype(float) - b).mean() for b in still] for a in moving])
            assert off.diagonal().max() < 4.0, "grey levels: coded, but the same picture"
            contact = np.flatnonzero(off.max(axis=0) > 6.0)  # pictures that look unlike others
            assert len(contact) > 3
            np.testing.assert_array_less(np.abs(off[contact].argmin(axis=1) - contact), 3)
    untouched: dict[Side, Path] = {side: folder / f"{side}.png" for side in SIDES}
    done = annotate(films, tmp_path / "ours", folder / "rig.yaml", None, untouched, method="paper")
    assert not done.failures
    rows = [
        r for f in sorted((tmp_path / "ours/data").rglob("*.parquet")) for r in pq.read_table(f).to_pylist()
    ]
    assert np.mean([r["observation.tip.valid"] for r in rows]) > 0.5


def test_a_film_that_ends_early_is_told(pictured: tuple[Episode, Path], tmp_path: Path):
    episode, folder = pictured
    root = filmed(theirs(tmp_path / "a", episode, "v2.1"), "v2.1", len(episode.position))
    source = open_lerobot(root)
    path, _ = source.video_file(0, source.tactile["left"])
    film(path, [np.zeros((240, 320, 3), np.uint8)] * 3, 10)
    with pytest.raises(RecordingError, match="holds 3 of the episode's"):
        list(LeRobotStream(source, 0, load_yaml(Rig, folder / "rig.yaml")).images("left"))
    path.write_bytes(b"no film")
    with pytest.raises(RecordingError, match="cannot be decoded"):
        list(LeRobotStream(source, 0, load_yaml(Rig, folder / "rig.yaml")).images("left"))


def test_a_dataset_without_tactile_images_is_refused_by_what_it_lacks(tmp_path: Path):
    root = theirs(tmp_path / "a", made_up(5), tactile=False)
    with pytest.raises(ConfigError, match="no tactile images of the left finger"):
        open_lerobot(root)
    with pytest.raises(ConfigError, match="end effector's pose"):
        open_lerobot(theirs(tmp_path / "b", made_up(5, images=True)), {"pose": "action"})
    (root / "meta/info.json").write_text("{}")
    with pytest.raises(RecordingError, match="not a LeRobot dataset"):
        open_lerobot(root)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("version", "variable"), [("v3.0", "TIPTRACE_LEROBOT_V30"), ("v2.1", "TIPTRACE_LEROBOT_V21")]
)
def test_the_lerobot_package_reads_20_trials_as_they_were(version: str, variable: str, tmp_path: Path):
    """Opt in: the variable names a Python interpreter with ``lerobot`` (make test-lerobot)."""
    python = os.environ.get(variable)
    if not python:
        pytest.skip(f"{variable} names no interpreter that has lerobot")
    folder = tmp_path / "recordings"
    folder.mkdir()
    sources = sources_of(simulated(folder, 20))
    export_dataset(sources, "lerobot", tmp_path / "tip", lerobot=LeRobotOptions(version))
    command = [python, str(READER), str(tmp_path / "tip"), str(tmp_path / "read.npz")]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    about: dict[str, Any] = json.loads((tmp_path / "read.json").read_text())
    assert (about["version"], about["episodes"], about["fps"]) == (version, 20, 25)
    read = np.load(tmp_path / "read.npz")
    episodes = [load_episode(s, "full") for s in sources]
    for name, parts in (
        ("observation.tip.position", [e.position for e in episodes]),
        ("observation.tip.covariance", [e.covariance.reshape(-1, 9) for e in episodes]),
    ):
        np.testing.assert_array_equal(read[name], np.concatenate(parts).astype(np.float32))
    np.testing.assert_array_equal(read["observation.tip.valid"], np.concatenate([e.valid for e in episodes]))
    np.testing.assert_array_equal(read["frame.stamp_ns"], np.concatenate([e.stamps[:, 0] for e in episodes]))
