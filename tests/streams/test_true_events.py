"""True events of simulated trials: what counts, what is too slight, and the same from frames and from the table."""

from pathlib import Path

import numpy as np
import pytest

from tiptrace.errors import RecordingError
from tiptrace.sim.spec import Lift, TrialSpec
from tiptrace.streams.simulated_files import write_trial
from tiptrace.streams.true_events import TrueEvents, _events, from_table, truth_table_of

FRAME_NS = 40_000_000


def of(
    free: tuple[int, int] = (0, 0), turn_deg: float = 0.0, shift_m: float = 0.0, tracing: bool = True
) -> TrueEvents:
    """100 frames; out of contact in frames free[0]..free[1]-1, turned and shifted within frames 50 to 55."""
    k = np.arange(100)
    part = np.clip((k - 50) / 5.0, 0.0, 1.0)
    touching = ~((k >= free[0]) & (k < free[1]))
    return _events(k * FRAME_NS, touching, np.full(100, tracing), turn_deg * part, shift_m * part)


def test_losses_count_from_a_fifth_of_a_second_on() -> None:
    found = of(free=(20, 26))
    assert [(e.kind, e.start_ns // FRAME_NS, e.end_ns // FRAME_NS) for e in found.events] == [
        ("contact-lost", 20, 25)
    ]
    assert found.slight == ()
    short = of(free=(20, 24))
    assert short.events == ()
    assert [e.kind for e in short.slight] == ["contact-lost"]


def test_what_happens_while_the_tip_rests_is_no_loss() -> None:
    found = of(free=(20, 40), tracing=False)
    assert found == TrueEvents((), ())


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(1.6, 0.0), (-1.6, 0.0), (0.0, 0.6e-3)])
def test_slips_by_turn_or_shift(turn_deg: float, shift_m: float) -> None:
    found = of(turn_deg=turn_deg, shift_m=shift_m)
    assert [e.kind for e in found.events] == ["grasp-slip"]
    assert found.events[0].start_ns <= 55 * FRAME_NS
    assert found.events[0].end_ns >= 55 * FRAME_NS


def test_a_slip_of_half_the_limit_is_slight_and_of_a_tenth_none() -> None:
    assert [e.kind for e in of(turn_deg=0.75).slight] == ["grasp-slip"]
    assert of(turn_deg=0.75).events == ()
    assert of(turn_deg=0.15) == TrueEvents((), ())


def test_a_lift_is_in_the_table_beside_the_recording(tmp_path: Path) -> None:
    spec = TrialSpec(
        trajectory="T1",
        tool="O1",
        wrist="W1",
        grasp="G1",
        level="clean",
        mode="markers",
        seed=3,
        anchoring_s=1.0,
        travel_m=0.04,
        lifts=(Lift(start_s=1.6, duration_s=1.0, height_m=6e-3),),
    )
    recording = tmp_path / "lifted.mcap"
    write_trial(spec, recording, truth_table_of(recording))
    found = from_table(truth_table_of(recording))
    losses = [e for e in found.events if e.kind == "contact-lost"]
    assert len(losses) == 1
    assert 0.2 < (losses[0].end_ns - losses[0].start_ns) * 1e-9 < 1.0


def test_another_table_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "x.truth.parquet"
    path.write_bytes(b"no parquet")
    with pytest.raises(RecordingError, match=r"x\.truth\.parquet"):
        from_table(path)
