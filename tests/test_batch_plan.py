"""Names and shares of a batch follow from the paths alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from tiptrace.batch_plan import find_recordings, is_batch, parse_shard, share
from tiptrace.errors import ConfigError


def touch(folder: Path, *names: str) -> list[Path]:
    files = [folder / name for name in names]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    return files


def names(*paths: Path, bags: bool = False) -> list[str]:
    return [item.name for item in find_recordings(paths, bags).recordings]


def test_a_folder_names_its_recordings_by_their_place(tmp_path: Path) -> None:
    touch(tmp_path, "b.mcap", "day1/a.mcap", "day2/a.mcap", "day2/a.v2.mcap", "day2/notes.txt")
    assert names(tmp_path) == ["b", "day1/a", "day2/a", "day2/a.v2"]


def test_equal_names_get_their_folders_in_front(tmp_path: Path) -> None:
    files = touch(tmp_path, "x/day1/a.mcap", "y/day1/a.mcap", "y/c.mcap")
    found = find_recordings(files)
    assert [item.name for item in found.recordings] == ["c", "x/day1/a", "y/day1/a"]
    assert any("same name" in note for note in found.notes)
    assert names(tmp_path / "x", tmp_path / "y") == ["c", "x/day1/a", "y/day1/a"]


def test_names_are_unique_where_only_the_suffix_differs(tmp_path: Path) -> None:
    touch(tmp_path, "a.mcap", "a.db3", "bag/metadata.yaml", "bag/bag_0.mcap")
    assert names(tmp_path, bags=True) == ["a_db3", "a_mcap", "bag"]


def test_globs_and_repeats(tmp_path: Path) -> None:
    touch(tmp_path, "u/a.mcap", "v/b.mcap")
    found = find_recordings([tmp_path / "**" / "*.mcap", tmp_path / "u" / "a.mcap", tmp_path / "none*"])
    assert [item.name for item in found.recordings] == ["a", "b"]
    assert any("given more than once" in note for note in found.notes)
    assert found.empty == ((str(tmp_path / "none*"), "matches nothing"),)


def test_nothing_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no recording"):
        find_recordings([tmp_path])


def test_what_is_a_batch(tmp_path: Path) -> None:
    (file,) = touch(tmp_path, "a.mcap")
    touch(tmp_path, "bag/metadata.yaml")
    (odd,) = touch(tmp_path, "trial[1].mcap")
    assert not any(is_batch([p]) for p in (file, odd, tmp_path / "missing.mcap", tmp_path / "bag"))
    assert all(is_batch(p) for p in ([file, file], [tmp_path], [tmp_path / "*.mcap"]))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
def test_shares_hold_each_recording_once_and_are_even(count: int, tmp_path: Path) -> None:
    touch(tmp_path, *(f"{k:02d}.mcap" for k in range(13)))
    recordings = find_recordings([tmp_path]).recordings
    shares = [share(recordings, parse_shard(f"{k + 1}/{count}")) for k in range(count)]
    assert sorted(i.name for part in shares for i in part) == [i.name for i in recordings]
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "-1/3", "1/0", "1.5/3"])
def test_wrong_shards_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected i/n"):
        parse_shard(text)
