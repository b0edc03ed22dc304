import csv
import shutil

import cv2
import numpy as np
import pytest

from tiptrace.calibration.gel import train_gel
from tiptrace.calibration.gel_circles import find_circles
from tiptrace.calibration.gel_data import Circle, read_press_folder
from tiptrace.calibration.gel_evaluation import angles_deg, fitted_radius_px, measured_slopes
from tiptrace.calibration.gel_shading import fit_shading
from tiptrace.config import Sensor, Transform
from tiptrace.errors import CalibrationError
from tiptrace.perception.background import untouched_background
from tiptrace.perception.gel_model import load_gel_model
from tiptrace.sim.dots import DotLayout
from tiptrace.sim.presses import render_press
from tiptrace.sim.render import TactileRenderer

from .gel_presses import MM_PER_PX, write

POSE = Transform(translation_m=(0, 0, 0.14), quaternion_xyzw=(0, 0, 0, 1))


@pytest.mark.parametrize("layout", [None, DotLayout()])
def test_contacts_are_found_without_being_told(layout, tmp_path):
    presses = write(tmp_path, layout, circles=False)
    data = read_press_folder(tmp_path, MM_PER_PX)
    circles = find_circles(data)
    H, W = data.reference.shape[:2]
    inner = [
        i for i, p in enumerate(presses) if 30 < p.center_px[0] < W - 30 and 30 < p.center_px[1] < H - 30
    ]
    off = [
        np.hypot(circles[i].u - presses[i].center_px[0], circles[i].v - presses[i].center_px[1])
        for i in inner
    ]
    size = [circles[i].radius / presses[i].contact_radius_px for i in inner]
    assert np.median(off) < 0.3
    assert max(off) < 1.5
    assert 0.85 < np.median(size) < 1.1


def test_wrong_circles_are_not_believed(tmp_path):
    presses = write(tmp_path)
    rows = list(csv.DictReader((tmp_path / "presses.csv").open()))
    for row in rows:
        row["center_u_px"] = str(float(row["center_u_px"]) + 12)
    with (tmp_path / "presses.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    circles = find_circles(read_press_folder(tmp_path, MM_PER_PX))
    off = [
        np.hypot(c.u - p.center_px[0], c.v - p.center_px[1]) for c, p in zip(circles, presses, strict=True)
    ]
    assert np.median(off) < 0.3


def test_held_out_presses_are_measured(trained):
    folder, _, report, told = trained
    assert report.normal_error_deg < 2.0
    assert report.radius_error < 0.05
    assert report.depth_rms_m < 20e-6
    assert report.flatness_m < 20e-6
    assert not report.one_place
    assert not report.scale_is_assumed
    assert len(report.held_out) == 3
    names = {s.name for s in report.held_out}
    assert not names & set(report.trained_on)
    for score in report.held_out:
        picture = cv2.imread(str(folder / "pictures" / score.name))
        assert picture is not None
        assert picture.shape[1] > 600
    assert told[-1][1] == pytest.approx(1.0)


def test_the_model_measures_presses_it_has_never_seen(trained):
    """Truth from the renderer: slopes of another session's presses on the same gel."""
    _, _, report, _ = trained
    gel = load_gel_model(report.model)
    assert gel.mm_per_px == MM_PER_PX
    assert gel.metadata["tiptrace.image_size_px"] == "320,240"
    renderer = TactileRenderer(seed=77)
    background = untouched_background(renderer.reference())
    errors = []
    for place, diameter, depth in (((100.0, 90.0), 5e-3, 0.8e-3), ((220.0, 150.0), 7e-3, 1.2e-3)):
        press = render_press(renderer, place, diameter, depth, frame=5)
        slopes = measured_slopes(gel, press.image, background, np.zeros(press.image.shape[:2], bool))
        touched = np.hypot(*np.moveaxis(press.slope, -1, 0)) > 0.1
        errors.append(np.median(angles_deg(slopes[touched], press.slope[touched])))
    assert max(errors) < 2.5


def test_presses_in_one_place_are_accepted_and_flagged(tmp_path):
    renderer = TactileRenderer(seed=1)
    cv2.imwrite(str(tmp_path / "reference.png"), renderer.reference())
    lines = ["image,ball_diameter_mm,mm_per_px"]
    for i in range(8):
        press = render_press(renderer, (160.0 + i, 120.0 - i), 4e-3, 0.4e-3 + 0.1e-3 * i, frame=i)
        cv2.imwrite(str(tmp_path / f"{i}.png"), press.image)
        lines.append(f"{i}.png,4,0.0625")
    (tmp_path / "presses.csv").write_text("\n".join(lines))
    report = train_gel(tmp_path, tmp_path / "gel.onnx")
    assert report.one_place
    assert report.mm_per_px == MM_PER_PX
    u0, v0, u1, v1 = report.valid_px
    assert 120 < u0 < 160 < u1 < 200
    assert 80 < v0 < 120 < v1 < 160
    gel = load_gel_model(report.model)
    assert gel.convention.coordinates == "zero"
    assert gel.metadata["tiptrace.one_place"] == "yes"


def test_sphere_fit_and_angles():
    v, u = np.indices((100, 120), dtype=float)
    R = 40.0
    depth = np.sqrt(np.maximum(R**2 - (u - 61.3) ** 2 - (v - 50.2) ** 2, 0)) - 30
    inside = np.hypot(u - 61.3, v - 50.2) < 25
    assert fitted_radius_px(depth, Circle(61.3, 50.2, 25), inside) == pytest.approx(R, rel=1e-6)
    assert angles_deg(np.array([[1.0, 0.0]]), np.array([[0.0, 0.0]]))[0] == pytest.approx(45.0)


def test_shading_holds_for_diffuse_lamps_and_zero_on_flat_gel():
    rng = np.random.default_rng(0)
    slopes, uv = rng.uniform(-0.8, 0.8, (4000, 2)), rng.uniform(0, 1, (4000, 2))
    normal = np.column_stack([slopes, np.ones(4000)]) / np.sqrt(1 + np.sum(slopes**2, axis=1))[:, None]
    lamps = np.array([[0.8, 0.1, 0.6], [-0.5, 0.7, 0.5], [0.0, -0.8, 0.6]])
    wide = lamps + rng.normal(0, 0.2, (40, 3, 3))  # every lamp has an extent
    light = np.maximum(np.einsum("nk,mlk->nml", normal, wide), 0).mean(axis=1)
    light /= np.maximum(wide[..., 2], 0).mean(axis=0)
    background = rng.uniform(60, 150, (4000, 3))
    shading = fit_shading(slopes, uv, background * light, background)
    assert np.all(shading.ratio_change(np.zeros((5, 2)), uv[:5]) == 0)
    error = background * (1 + shading.ratio_change(slopes, uv) - light)
    assert np.sqrt(np.mean(error**2)) < 1.3  # grey levels: the least noise of a channel of the real sensor


def small_folder(tmp_path):
    renderer = TactileRenderer(seed=2)
    cv2.imwrite(str(tmp_path / "reference.png"), renderer.reference())
    lines = ["image,ball_diameter_mm"]
    for i in range(6):
        press = render_press(renderer, (60.0 + 35 * i, 70.0 + 20 * i), 4e-3, 0.8e-3, frame=i)
        cv2.imwrite(str(tmp_path / f"{i}.png"), press.image)
        lines.append(f"{i}.png,4")
    (tmp_path / "presses.csv").write_text("\n".join(lines))
    return renderer


def touched_reference(folder, renderer):
    from tiptrace.sim.gel import PadContact, deform

    grid = deform(PadContact(np.full((1, 1), -1.0), np.zeros((0, 2)), np.zeros((0, 2)))).grid
    X, _ = grid.mesh()
    overlap = np.where(np.abs(X) < 3e-3, 0.9e-3, 0.9e-3 - 3.0 * (np.abs(X) - 3e-3))
    tool = deform(PadContact(overlap, np.zeros((0, 2)), np.zeros((0, 2))))
    cv2.imwrite(str(folder / "reference.png"), renderer.render(tool))


def spoil(name):
    def csv_text(text):
        return lambda folder, _: (folder / "presses.csv").write_text(text)

    def image(path, picture):
        return lambda folder, _: cv2.imwrite(str(folder / path), picture)

    return {
        "no reference": lambda folder, _: (folder / "reference.png").unlink(),
        "no csv": lambda folder, _: (folder / "presses.csv").unlink(),
        "few": csv_text("image,ball_diameter_mm\n0.png,4\n1.png,4\n"),
        "column": csv_text("image,diameter\n0.png,4\n"),
        "number": csv_text("image,ball_diameter_mm\n0.png,four\n"),
        "ball": csv_text("image,ball_diameter_mm\n0.png,400\n"),
        "scale": csv_text("image,ball_diameter_mm,mm_per_px\n" + "0.png,4,wide\n" * 6),
        "two scales": csv_text("image,ball_diameter_mm,mm_per_px\n" + "0.png,4,0.06\n0.png,4,0.03\n" * 3),
        "no press": lambda folder, _: shutil.copy(folder / "reference.png", folder / "3.png"),
        "half a circle": csv_text("image,ball_diameter_mm,center_u_px\n0.png,4,100\n"),
        "absent image": csv_text("image,ball_diameter_mm\nx.png,4\n"),
        "unreadable": lambda folder, _: (folder / "3.png").write_bytes(b"no image"),
        "size": image("3.png", np.full((480, 640, 3), 90, np.uint8)),
        "black": image("3.png", np.zeros((240, 320, 3), np.uint8)),
        "overexposed": image("reference.png", np.full((240, 320, 3), 255, np.uint8)),
        "touched": touched_reference,
    }[name]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no reference", r"reference\.png is missing"),
        ("no csv", r"presses\.csv: cannot be read"),
        ("few", "2 presses, need at least 6"),
        ("column", "column 'ball_diameter_mm' is missing"),
        ("number", "line 2: could not convert"),
        ("ball", "ball_diameter_mm is 400"),
        ("scale", "mm_per_px is 'wide'"),
        ("two scales", "mm_per_px differs between rows"),
        ("no press", r"3\.png: shows no press; remove it"),
        ("half a circle", "give all of center_u_px, center_v_px, contact_radius_px or none"),
        ("absent image", r"x\.png is missing"),
        ("unreadable", r"3\.png is not a readable image"),
        ("size", r"3\.png is 640×480 px, reference\.png is 320×240"),
        ("black", r"3\.png: tactile image is black"),
        ("overexposed", r"reference\.png: tactile image is overexposed"),
        ("touched", "looks touched or dirty"),
    ],
)
def test_bad_folders_are_refused_with_the_reason(name, message, tmp_path):
    renderer = small_folder(tmp_path)
    spoil(name)(tmp_path, renderer)
    with pytest.raises(CalibrationError, match=message):
        train_gel(tmp_path, tmp_path / "gel.onnx")


def test_a_gel_that_is_not_the_rigs_is_refused(tmp_path):
    write(tmp_path, DotLayout(), columns=3, rows=2)
    believed = Sensor(mm_per_px=MM_PER_PX, marker_pitch_mm=1.2, T_E_S=POSE)
    with pytest.raises(CalibrationError, match=r"mm apart .* the rig says 1\.2 mm: another gel is mounted"):
        train_gel(tmp_path, tmp_path / "gel.onnx", sensor=believed)
    believed = Sensor(mm_per_px=MM_PER_PX, image_size_px=(640, 480), T_E_S=POSE)
    with pytest.raises(CalibrationError, match=r"320×240 px, the rig says 640×480"):
        train_gel(tmp_path, tmp_path / "gel.onnx", sensor=believed)
