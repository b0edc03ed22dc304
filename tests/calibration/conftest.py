"""One calibrated gel for all tests of calibration."""

import pytest

from tiptrace.calibration.gel import train_gel

from .gel_presses import MM_PER_PX, write


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("presses")
    presses = write(folder, circles=False)
    out = folder / "gel.onnx"
    told = []
    report = train_gel(
        folder,
        out,
        mm_per_px=MM_PER_PX,
        pictures=folder / "pictures",
        progress=lambda label, share: told.append((label, share)),
    )
    return folder, presses, report, told
