"""Ground truth from files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tiptrace.errors import OutputError
from tiptrace.evaluation.truth_files import read_truth


def test_csv_and_tum(tmp_path: Path):
    (tmp_path / "a.csv").write_text("frame,stamp_ns,x_m,y_m,z_m\n0,1700000000123456789,0.1,0.2,0.3\n1,5,,,\n")
    (tmp_path / "a.tum").write_text("# comment\n1700000000.123456789 0.1 0.2 0.3 0 0 0 1\n\n")
    for name in ("a.csv", "a.tum"):
        (sample,) = read_truth(tmp_path / name)
        assert sample.stamp_ns == 1_700_000_000_123_456_789
        assert sample.p_B.tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("t.csv", "t,x,y,z\n1,2,3,4\n", "lacks the column"),
        ("t.csv", "stamp_ns,x_m,y_m,z_m\n1,a,3,4\n", "line 2"),
        ("t.csv", "stamp_ns,x_m,y_m,z_m\n", "no true position"),
        ("t.csv", "stamp_ns,x_m,y_m,z_m\n1,400,3,4\n", "millimetres"),
        ("t.tum", "1 2\n", "line 1"),
        ("t.tum", "x 0 0 0\n", "line 1"),
    ],
)
def test_what_is_no_truth_is_refused_by_name(tmp_path: Path, name: str, text: str, words: str):
    (tmp_path / name).write_text(text)
    with pytest.raises(OutputError, match=words) as caught:
        read_truth(tmp_path / name)
    assert name in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(OutputError, match="absent"):
        read_truth(tmp_path / "absent.tum")
