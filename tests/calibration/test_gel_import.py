import io
import itertools
import pickle
import zipfile
from collections import OrderedDict

import cv2
import numpy as np
import pytest
import scipy.fft

from tiptrace.calibration.gel_import import import_gel, read_torch_tensors
from tiptrace.errors import CalibrationError
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.perception.poisson import PoissonSolver

H, W = 240, 320
IMAGES = (0, 1, 2, 21)


def slopes_of(model, image):
    v, u = np.indices((H, W), dtype=np.float32)
    uv = np.stack([u / W, v / H], axis=-1).reshape(-1, 2)
    return model.slopes(image.astype(np.float32).reshape(-1, 3), uv).reshape(H, W, 2)


def vendor_height(slopes):
    """Integration as the vendor's software weighs it: cosine frequencies counted from 1, not from 0."""
    p, q = slopes[..., 0].astype(np.float64), slopes[..., 1].astype(np.float64)
    f = np.zeros((H, W))
    p_half, q_half = (p[:, 1:] + p[:, :-1]) / 2, (q[1:] + q[:-1]) / 2
    f[:, :-1] += p_half
    f[:, 1:] -= p_half
    f[:-1] += q_half
    f[1:] -= q_half
    k_u, k_v = np.arange(1, W + 1) / W, np.arange(1, H + 1) / H
    weight = 4 * (np.sin(0.5 * np.pi * k_u)[None] ** 2 + np.sin(0.5 * np.pi * k_v)[:, None] ** 2)
    return scipy.fft.idctn(-scipy.fft.dctn(f, norm="ortho") / weight, norm="ortho")


@pytest.fixture(scope="module")
def vendor(shared_data, tmp_path_factory):
    folder = shared_data / "gelsight_mini_sdk_model"
    out = tmp_path_factory.mktemp("gel") / "nnmini.onnx"
    report = import_gel(folder / "nnmini.pt", out, "gsrobotics")
    assert report.layers == (5, 64, 64, 64, 2)
    model = load_gel_model(out)
    slopes = {i: slopes_of(model, cv2.imread(str(folder / f"img_{i}.png"))) for i in IMAGES}
    depth = {i: np.load(folder / f"depthmap_{i}.npy") for i in IMAGES}
    return slopes, depth


def correlations(heights, depth):
    return [
        -np.corrcoef((heights[a] - heights[b]).ravel(), (depth[a] - depth[b]).ravel())[0, 1]
        for a, b in itertools.combinations(IMAGES, 2)
    ]


def test_vendor_network_reproduces_the_vendors_depth(vendor):
    """Height is out of the gel, the vendor's maps count what is pressed in: hence the minus sign."""
    slopes, depth = vendor
    assert min(correlations({i: vendor_height(s) for i, s in slopes.items()}, depth)) >= 0.99
    solver = PoissonSolver((H, W), (1.0, 1.0))
    metric = {i: solver.integrate(s[..., 0].copy(), s[..., 1].copy()) for i, s in slopes.items()}
    assert min(correlations(metric, depth)) >= 0.87


def test_conventions_are_not_interchangeable(vendor, shared_data, tmp_path):
    """With true coordinates, or red and blue exchanged, the same weights fit the vendor's output worse."""
    _, depth = vendor
    folder = shared_data / "gelsight_mini_sdk_model"
    for name in ("gsrobotics-unit", "gsrobotics-rgb"):
        import_gel(folder / "nnmini.pt", tmp_path / "other.onnx", name)
        model = load_gel_model(tmp_path / "other.onnx")
        heights = {
            i: vendor_height(slopes_of(model, cv2.imread(str(folder / f"img_{i}.png")))) for i in IMAGES
        }
        assert min(correlations(heights, depth)) < 0.99


def test_gs_sdk_weights_press_the_gel_in(shared_data, tmp_path):
    """Independent of the vendor's maps: the wedge of image 0 is pressed in, its height is below the rest."""
    folder = shared_data / "gelsight_mini_sdk_model"
    report = import_gel(folder / "gs_sdk_nnmodel.pth", tmp_path / "g.onnx", "gs-sdk")
    assert report.layers == (5, 32, 32, 32, 2)
    model = load_gel_model(tmp_path / "g.onnx")
    s = [slopes_of(model, cv2.imread(str(folder / f"img_{i}.png"))) for i in (0, 21)]
    z = PoissonSolver((H, W), (1.0, 1.0)).integrate(*np.moveaxis(s[0] - s[1], -1, 0).copy())
    assert np.median(z[160:170, 110:240]) < np.median(z[:60]) - 3


def torch_file(path, content):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", content)
    return path


class Malicious:
    def __reduce__(self):
        return (print, ("executed",))


@pytest.mark.parametrize("payload", [Malicious(), OrderedDict(a=Malicious()), np.zeros(3)])
def test_a_pickle_that_asks_for_more_is_refused_before_it_runs(payload, tmp_path, capsys):
    with pytest.raises(CalibrationError, match="refused"):
        read_torch_tensors(torch_file(tmp_path / "bad.pt", pickle.dumps(payload, protocol=2)))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "content", [b"", b"\x80\x02}q", pickle.dumps({"a": 1}, protocol=2), pickle.dumps([1], protocol=2)]
)
def test_broken_files_are_refused(content, tmp_path):
    path = torch_file(tmp_path / "bad.pt", content)
    with pytest.raises(CalibrationError):
        import_gel(path, tmp_path / "out.onnx", "gsrobotics")
    (tmp_path / "text.pt").write_bytes(b"hello")
    with pytest.raises(CalibrationError, match="not a torch zip file"):
        read_torch_tensors(tmp_path / "text.pt")
    with pytest.raises(CalibrationError, match="not a torch zip file"):
        read_torch_tensors(tmp_path / "absent.pt")


def test_a_truncated_file_is_refused(shared_data, tmp_path):
    whole = (shared_data / "gelsight_mini_sdk_model" / "nnmini.pt").read_bytes()
    source = zipfile.ZipFile(io.BytesIO(whole))
    with zipfile.ZipFile(tmp_path / "cut.pt", "w") as archive:
        for name in source.namelist():
            archive.writestr(name, source.read(name)[: 100 if name.endswith("data/2") else None])
    with pytest.raises(CalibrationError):
        read_torch_tensors(tmp_path / "cut.pt")


def test_unknown_convention(tmp_path):
    with pytest.raises(CalibrationError, match="known: gsrobotics"):
        import_gel(tmp_path / "x.pt", tmp_path / "x.onnx", "matlab")
