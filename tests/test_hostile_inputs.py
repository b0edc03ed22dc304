"""Files from anybody: bounded in time and memory, never a traceback, never code of theirs."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Chunk

from tiptrace.calibration.gel_import import read_torch_tensors
from tiptrace.config import Rig, parse_yaml, read_yaml
from tiptrace.errors import CalibrationError, ConfigError, PerceptionError, RecordingError
from tiptrace.perception.gel_graph import check_graph
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.streams.bag_checks import check_bag
from tiptrace.streams.chunks import unpacked
from tiptrace.streams.definitions import is_own_definition, schema_text
from tiptrace.streams.image_bytes import decode_image, image_size

ROOT = Path(__file__).resolve().parents[1]
LAUGHS = "a0: &a0 [x, x]\n" + "\n".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40))
MERGES = "m0: &m0 {x: 1}\n" + "\n".join(f"m{k}: &m{k} {{<<: [*m{k - 1}, *m{k - 1}]}}" for k in range(1, 40))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (LAUGHS, "aliases"),
        (MERGES, "aliases"),
        ("a: &a [*a]", "aliases"),
        ("[" * 50_000, "YAML"),
        ("x" * 300_000, "no settings file"),
        ("a: 2001-99-99", "YAML"),
        ("a: !!python/object/apply:os.system ['true']", "YAML"),
        ("a: " + "1" * 5000, "YAML"),
        ("? [a, b]\n: 1", "YAML"),
        (b"\xff\xfe\x00", "YAML"),
    ],
)
def test_yaml_of_few_bytes_that_means_too_much_or_nothing(text: str | bytes, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        read_yaml(text, "rig.yaml")


def test_anchors_in_moderation_are_fine() -> None:
    assert read_yaml("left: &s {a: 1}\nright: {<<: *s, b: 2}", "x") == {
        "left": {"a": 1},
        "right": {"a": 1, "b": 2},
    }
    assert read_yaml("", "x") is None


def test_a_rig_with_nan_is_refused() -> None:
    with pytest.raises(ConfigError, match="finite"):
        parse_yaml(Rig, "gripper: {opening_m: 0.006, closing_axis_E: [.nan, 0, 0]}", "rig.yaml")


def chunk(size: int, data: bytes, compression: str = "zstd") -> Chunk:
    return Chunk(compression, data, 0, 0, 0, size)


def test_chunks_that_grow_beyond_bounds() -> None:
    zeros = zstandard.compress(bytes(2**25))
    with pytest.raises(ValueError, match="claims"):
        unpacked(chunk(2**25, zeros))
    with pytest.raises(ValueError, match="claims"):
        unpacked(chunk(2**40, b"x" * 1000))
    with pytest.raises(ValueError, match="packed as"):
        unpacked(chunk(100, b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**36) + b"\x01\x00\x00"))
    record = struct.pack("<BQ", 5, 22) + bytes(22)
    with pytest.raises(ValueError, match="records"):
        unpacked(chunk(31 * 200_000, zstandard.compress(record * 200_000)))


def test_a_sound_chunk_is_unpacked() -> None:
    data = struct.pack("<BQ", 5, 22) + bytes(22)
    assert unpacked(chunk(31, zstandard.compress(data))).data == data
    assert unpacked(chunk(31, data, "")).data == data


def test_pictures_that_claim_to_be_enormous_are_not_decoded() -> None:
    import cv2

    image = np.full((24, 32, 3), 90, np.uint8)
    jpeg, png = (cv2.imencode(suffix, image)[1].tobytes() for suffix in (".jpg", ".png"))
    for data in (jpeg, png):
        assert image_size(data) == (32, 24)
        assert decode_image(data).shape == (24, 32, 3)
    huge_png = png[:16] + struct.pack(">II", 65535, 65535) + png[24:]
    at = jpeg.find(b"\xff\xc0")
    huge_jpeg = jpeg[: at + 5] + struct.pack(">HH", 65535, 65535) + jpeg[at + 9 :]
    for data in (huge_png, huge_jpeg, cv2.imencode(".bmp", image)[1].tobytes(), b"", b"\xff\xd8\xff"):
        assert decode_image(data) is None


def test_definitions_of_the_file_s_own_are_not_followed() -> None:
    text = schema_text("geometry_msgs/msg/PoseStamped")
    assert is_own_definition("geometry_msgs/msg/PoseStamped", text.encode())
    assert is_own_definition("geometry_msgs/msg/PoseStamped", ("# a comment\n\n" + text).encode())
    for evil in (
        text.replace("float64 x", "float64[400000000] x"),
        "E[] stamp\n" + "=" * 80 + "\nMSG: x/E\n",
    ):
        assert not is_own_definition("geometry_msgs/msg/PoseStamped", evil.encode())


# --- gel models ----------------------------------------------------------------------------------------------


@pytest.fixture
def model():
    onnx = pytest.importorskip("onnx")
    return onnx.load(ROOT / "src/tiptrace/models/gelsight-mini-virtual.onnx")


def test_weights_in_another_file_are_refused(model) -> None:
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = 1
    tensor.external_data.add(key="location", value="/etc/passwd")
    with pytest.raises(PerceptionError, match="another file"):
        load_gel_model(model.SerializeToString())


@pytest.mark.parametrize(
    ("operator", "domain"), [("Loop", ""), ("ConstantOfShape", ""), ("Gemm", "com.example")]
)
def test_operators_that_no_gel_needs_are_refused(model, operator: str, domain: str) -> None:
    model.graph.node[0].op_type, model.graph.node[0].domain = operator, domain
    with pytest.raises(PerceptionError, match="operator"):
        load_gel_model(model.SerializeToString())


@pytest.mark.parametrize("value", ["nan", "0", "", "abc", "-1", "inf"])
def test_metadata_that_are_no_number_are_refused(model, value: str) -> None:
    for pair in model.metadata_props:
        if pair.key.endswith("input_scale"):
            pair.value = value
    with pytest.raises(PerceptionError, match="input_scale"):
        load_gel_model(model.SerializeToString())


def test_the_packaged_model_and_nothing_else_passes(model) -> None:
    check_graph(model.SerializeToString(), "x")
    for data in (b"", b"\x00" * 100, b"ORTM" * 50, bytes(3_000_000)):
        with pytest.raises(PerceptionError):
            check_graph(data, "x")


def test_a_zip_bomb_for_weights(tmp_path: Path) -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(32_000_000))
    (tmp_path / "w.pt").write_bytes(out.getvalue())
    with pytest.raises(CalibrationError, match="too many"):
        read_torch_tensors(tmp_path / "w.pt")


def test_a_bag_whose_table_is_a_program(tmp_path: Path) -> None:
    import sqlite3

    with sqlite3.connect(tmp_path / "bag.db3") as base:
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n+1 FROM c) SELECT n FROM c"
        )
    with pytest.raises(RecordingError, match="view"):
        check_bag(tmp_path / "bag.db3")


# --- at random -----------------------------------------------------------------------------------------------


def fuzz(count: int, seed: int, out: Path) -> list[dict]:
    command = [sys.executable, str(ROOT / "benchmarks" / "fuzz_inputs.py"), "--json", str(out)]
    done = subprocess.run(
        [*command, "--count", str(count), "--seed", str(seed)], capture_output=True, text=True, timeout=1800
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    return json.loads(out.read_text())


def test_a_sample_of_mutants(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    outcomes = fuzz(12, 1, tmp_path / "outcomes.json")
    assert {o["code"] for o in outcomes} == {0, 2}


@pytest.mark.slow
def test_more_mutants(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    assert len(fuzz(300, 2, tmp_path / "outcomes.json")) == 300
