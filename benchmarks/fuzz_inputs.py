"""Mutated recordings, settings and gel models against the command line: python benchmarks/fuzz_inputs.py --count 1000.

Each mutant runs in a process of its own, forked from one that has imported everything. It must end with exit code 0
(used), or 2 with one sentence; without a traceback, within 10 s of processor time, 10 s of waiting and 1 GB of memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import statistics
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from fuzz_bytes import any_image, any_yaml, write
from fuzz_models import any_model, any_weights
from fuzz_recordings import any_bag_file, any_recording
from fuzz_sound import Sound, make_sound

CPU_LIMIT_S, WAIT_LIMIT_S, MEMORY_LIMIT_MB = 10.0, 10.0, 1000.0
_ADDRESS_SPACE = 6 * 2**30  # the machine's protection; what counts is the memory that was used


@dataclass(frozen=True)
class Outcome:
    """What came of one mutant."""

    index: int
    kind: str
    command: str
    code: int
    cpu_s: float
    wall_s: float
    memory_mb: float
    said: str
    fault: str


def prepare(kind: str, index: int, seed: int, sound: Sound, folder: Path) -> list[str]:
    """Write a mutant of a kind; gives the command line that meets it."""
    rng = np.random.default_rng([seed, index])
    out = str(folder / "out")
    run = ["reconstruct", "--no-report", "--out", out]
    trial = str(sound.trial)

    def mutant(name: str, change: Callable[[bytes, np.random.Generator], bytes], source: Path) -> str:
        return str(write(folder / name, change(source.read_bytes(), rng)))

    if kind == "recording":
        path = mutant("trial.mcap", any_recording, sound.trial)
        return ["inspect", path] if rng.random() < 0.2 else [*run, path]
    if kind == "rig":
        return [*run, trial, "--rig", mutant("rig.yaml", any_yaml, sound.rig)]
    if kind == "tool":
        return [*run, trial, "--tool", mutant("tool.yaml", any_yaml, sound.tool)]
    if kind == "map":
        return [*run, trial, *sound.foreign, "--map", mutant("map.yaml", any_yaml, sound.map_file)]
    if kind == "reference":
        return [*run, trial, "--reference-left", mutant("left.png", any_image, sound.reference)]
    if kind == "model":
        model = mutant("gel.onnx", any_model, sound.model)
        text = sound.rig.read_text().replace("gelsight-mini-virtual", model)
        return [*run, trial, "--rig", str(write(folder / "rig.yaml", text.encode()))]
    if kind == "weights":
        weights = mutant("weights.pt", any_weights, sound.weights)
        return ["import-gel", weights, "--convention", "gsrobotics", "--out", str(folder / "gel.onnx")]
    bag = folder / "bag"
    shutil.copytree(sound.bags[int(rng.integers(len(sound.bags)))], bag)
    files = sorted(file for file in bag.iterdir())
    victim = files[int(rng.integers(len(files)))]
    change = any_yaml if victim.suffix == ".yaml" else any_bag_file
    victim.write_bytes(change(victim.read_bytes(), rng))
    return ["inspect", str(bag)] if rng.random() < 0.3 else [*run, str(bag), *sound.foreign]


KINDS: dict[str, float] = {
    "recording": 0.5,
    "rig": 0.14,
    "model": 0.12,
    "bag": 0.08,
    "tool": 0.04,
    "map": 0.04,
    "reference": 0.04,
    "weights": 0.04,
}


def run_case(index: int, kind: str, seed: int, sound: Sound, folder: Path) -> Outcome:
    """One mutant in a forked process."""
    folder.mkdir()
    argv = prepare(kind, index, seed, sound, folder)
    said_file = folder / "said.txt"
    started = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _child(argv, said_file, folder)
    status, usage = _wait(pid, started)
    wall_s = time.monotonic() - started
    said = said_file.read_text(errors="replace") if said_file.exists() else ""
    code = os.waitstatus_to_exitcode(status)
    cpu_s, memory_mb = usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024
    fault = _fault(code, said, cpu_s, memory_mb)
    if (folder / "pwned").exists():
        fault = "ran a command"
    command = " ".join(argv).replace(str(folder), "DIR").replace(str(sound.trial.parent), "SOUND")
    return Outcome(index, kind, command, code, cpu_s, wall_s, memory_mb, said.strip(), fault)


def _child(argv: list[str], said: Path, folder: Path) -> None:
    code = 99
    try:
        handle = os.open(said, os.O_CREAT | os.O_WRONLY)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (40, 41))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (2 * 2**30, 2 * 2**30))
        sys.argv = ["tiptrace", *argv]
        from tiptrace.cli import main

        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001  (a traceback is what this looks for)
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _wait(pid: int, started: float) -> tuple[int, resource.struct_rusage]:
    """Wait for a mutant. Its clock runs while it waits for something, not while it waits for a processor."""
    last, waited_s = started, 0.0
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            return status, usage
        now = time.monotonic()
        if _sleeps(pid):
            waited_s += min(now - last, 1.0)  # more, and this process was stopped itself
        last = now
        if waited_s > WAIT_LIMIT_S:
            os.kill(pid, signal.SIGKILL)
            _, status, usage = os.wait4(pid, 0)
            return status, usage
        time.sleep(0.005)


def _sleeps(pid: int) -> bool:
    """Every thread waits: none runs or is ready to (R), is stopped from outside (T) or reads a disk (D)."""
    try:
        threads = [task.read_text() for task in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:  # one has just ended
        return False
    states = {thread.rpartition(")")[2].split()[0] for thread in threads}
    return states <= {"S"}  # also where there is no /proc


def _fault(code: int, said: str, cpu_s: float, memory_mb: float) -> str:
    if "Traceback" in said or code == 99:
        return "traceback"
    if cpu_s > CPU_LIMIT_S or code == -signal.SIGKILL:
        return "hang"
    if memory_mb > MEMORY_LIMIT_MB:
        return "memory"
    if code not in (0, 2):
        return f"exit code {code}"
    if code == 2 and "error: " not in said and "Error" not in said:
        return "no message"
    return ""


def warm_up(sound: Sound, folder: Path) -> None:
    """Import all that the commands need, once; also shows that the sound files are sound."""
    import cv2

    cv2.setNumThreads(0)
    import matplotlib  # noqa: F401
    import onnx  # noqa: F401
    import onnxruntime  # noqa: F401
    import rosbags.highlevel  # noqa: F401

    import tiptrace.cli
    import tiptrace.reconstruction
    import tiptrace.streams.inspection  # noqa: F401
    from tiptrace.perception.warm_up import warm_up as compile_loops

    compile_loops()
    for name, argv in {
        "recording": ["reconstruct", str(sound.trial), "--no-report", "--out", str(folder / "a")],
        "bag": ["reconstruct", str(sound.bags[0]), *sound.foreign, "--no-report", "--out", str(folder / "b")],
        "weights": [
            "import-gel",
            str(sound.weights),
            "--convention",
            "gsrobotics",
            "--out",
            str(folder / "c.onnx"),
        ],
    }.items():
        pid = os.fork()
        if pid == 0:
            _child(argv, folder / f"{name}.txt", folder)
        status, _ = _wait(pid, time.monotonic())
        if os.waitstatus_to_exitcode(status):
            raise SystemExit(f"the sound {name} fails:\n{(folder / f'{name}.txt').read_text()}")


def summary(outcomes: list[Outcome]) -> str:
    """A table by kind."""
    lines = ["kind        mutants  used  refused  faults   cpu s: median, max   memory MB: max"]
    for kind in [*KINDS, "all"]:
        rows = [o for o in outcomes if kind in (o.kind, "all")]
        if rows:
            codes, faults = Counter(o.code for o in rows), sum(bool(o.fault) for o in rows)
            cpu = [o.cpu_s for o in rows]
            lines.append(
                f"{kind:<12}{len(rows):>6}{codes[0]:>7}{codes[2]:>8}{faults:>8}"
                f"{statistics.median(cpu):>12.2f}{max(cpu):>8.2f}{max(o.memory_mb for o in rows):>16.0f}"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), help="only this kind")
    parser.add_argument("--only", type=int, help="only this mutant, and what it says")
    parser.add_argument("--json", type=Path, help="all outcomes")
    args = parser.parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # a process with threads cannot be forked safely
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        os.execv(sys.executable, [sys.executable, *sys.argv])
    kinds = [args.kind] if args.kind else list(KINDS)
    weights = np.array([KINDS[kind] for kind in kinds])
    chosen = np.random.default_rng(args.seed).choice(kinds, args.count, p=weights / weights.sum())
    outcomes = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sound = make_sound(folder / "sound")
        warm_up(sound, folder)
        for index in [args.only] if args.only is not None else range(args.count):
            outcome = run_case(index, str(chosen[index]), args.seed, sound, folder / "case")
            shutil.rmtree(folder / "case")
            outcomes.append(outcome)
            if outcome.fault or args.only is not None:
                print(f"#{index} {outcome.kind}: {outcome.fault or 'fine'}: {outcome.command}")
                print("   " + outcome.said[-1500:].replace("\n", "\n   "), flush=True)
    print(summary(outcomes))
    if args.json:
        args.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    return 1 if any(o.fault for o in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
