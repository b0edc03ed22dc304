import numpy as np
import pytest

from tiptrace.calibration.gel_onnx import mlp_to_onnx
from tiptrace.errors import PerceptionError
from tiptrace.perception.gel_model import Convention, GelModel, load_gel_model

SURFACE = np.array([[0.3, -0.2], [0.0, 0.0], [1.2, 0.5]], np.float32)  # true slopes


def model_of(outputs, **convention):
    """A network whose output is constant."""
    return [GelModel(mlp_to_onnx([np.zeros((5, 2))], [row], Convention(**convention))) for row in outputs]


@pytest.mark.parametrize("z_axis", ["out", "in"])
def test_every_output_convention_gives_the_same_slopes(z_axis):
    sign = 1 if z_axis == "out" else -1
    n_z = 1 / np.sqrt(1 + np.sum(SURFACE**2, axis=1, keepdims=True))
    outputs = {
        "slopes": sign * SURFACE,
        "angles": np.arctan(sign * SURFACE),
        "normals": -sign * SURFACE * n_z,
    }
    for output, rows in outputs.items():
        for model, truth in zip(model_of(rows, output=output, z_axis=z_axis), SURFACE, strict=True):
            found = model.slopes(np.zeros((1, 3), np.float32), np.zeros((1, 2), np.float32))
            np.testing.assert_allclose(found[0], truth, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("row", [(np.nan, 0.0), (2.0, 2.0), (-1.0, 0.0)])
def test_impossible_normals_stay_finite(row):
    (model,) = model_of([row])
    assert np.isfinite(model.slopes(np.zeros((1, 3), np.float32), np.zeros((1, 2), np.float32))).all()


def test_channels_scale_and_coordinates():
    probe = np.array([[51.0, 102.0, 204.0]], np.float32)
    uv = np.array([[0.25, 0.75]], np.float32)
    pick = np.zeros((5, 2))
    pick[0, 0] = pick[4, 1] = 1.0

    def out(**convention):
        return GelModel(mlp_to_onnx([pick], [np.zeros(2)], Convention(output="slopes", **convention))).slopes(
            probe, uv
        )[0]

    np.testing.assert_allclose(out(), [0.2, 0.75])
    np.testing.assert_allclose(out(channels="rgb"), [0.8, 0.75])
    np.testing.assert_allclose(out(coordinates="zero"), [0.2, 0.0])
    np.testing.assert_allclose(out(input_scale=102.0), [0.5, 0.75])


def test_metadata_survives_the_file(tmp_path):
    convention = Convention(
        channels="rgb", coordinates="zero", background="ratio", input_scale=1.0, output="angles"
    )
    path = tmp_path / "gel.onnx"
    path.write_bytes(
        mlp_to_onnx([np.zeros((5, 2))], [np.zeros(2)], convention, metadata={"mm_per_px": "0.06,0.07"})
    )
    model = load_gel_model(path)
    assert model.convention == convention
    assert model.mm_per_px == (0.06, 0.07)
    assert load_gel_model(path.read_bytes()).convention == convention


def test_what_is_no_gel_model_is_refused(tmp_path):
    import onnx

    with pytest.raises(PerceptionError, match="neither a file nor a packaged model"):
        load_gel_model("no-such-gel")
    with pytest.raises(PerceptionError, match="not a readable ONNX file"):
        load_gel_model(b"nonsense")
    good = mlp_to_onnx([np.zeros((5, 2))], [np.zeros(2)], Convention())
    silent = onnx.load_from_string(good)
    del silent.metadata_props[:]
    with pytest.raises(PerceptionError, match="does not say its convention"):
        load_gel_model(silent.SerializeToString())
    wrong = onnx.load_from_string(good)
    next(p for p in wrong.metadata_props if p.key == "tiptrace.output").value = "colours"
    with pytest.raises(PerceptionError, match="known: normals, slopes, angles"):
        load_gel_model(wrong.SerializeToString())
