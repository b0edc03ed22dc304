"""``tiptrace inspect``: what a recording holds and whether it is usable."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from tiptrace.streams.inspection import Inspection


def inspect(
    src: Annotated[Path, typer.Argument(help="MCAP file, rosbag2 folder or .db3 file.")],
    write_map: Annotated[
        Path | None,
        typer.Option(help="Write the proposed map of another bag here, for --map after a look at it."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List a recording's topics, rates, gaps and clocks, and say whether tiptrace can use it.

    Examples:

      tiptrace inspect trial.mcap

      tiptrace inspect bag_folder --write-map map.yaml
    """
    import json

    from rich.console import Console

    from tiptrace.config import dump_yaml
    from tiptrace.errors import ConfigError
    from tiptrace.streams.inspection import inspect_recording, to_dict

    found = inspect_recording(src)
    if write_map is not None:
        if found.proposed_map is None:
            why = (
                "it is in tiptrace's format and needs none" if found.own_format else "; ".join(found.problems)
            )
            raise ConfigError(f"{src}: no map can be proposed: {why}")
        if write_map.exists():
            raise ConfigError(f"{write_map}: exists already; remove it or choose another name")
        try:
            write_map.write_text(dump_yaml(found.proposed_map))
        except OSError as error:
            raise ConfigError(f"{write_map}: cannot be written ({error.strerror})") from None
    if as_json:
        typer.echo(json.dumps(to_dict(found), indent=2))
        return
    console = Console()
    console.print(_table(found))
    for line in _verdict(found, write_map):
        console.print(line, highlight=False, soft_wrap=True)


def _table(found: Inspection) -> Table:
    from rich.markup import escape
    from rich.table import Table

    kind = "tiptrace recording" if found.own_format else "recording of another origin"
    table = Table(title=escape(f"{found.path}: {kind}, {found.duration_s:.2f} s"), title_justify="left")
    table.add_column("topic", overflow="fold")
    table.add_column("type", overflow="fold")
    for name in ("count", "rate\nHz", "longest\ngap s", "from … to\ns", "header −\nlog s"):
        table.add_column(name, justify="right")
    table.add_column("size\npx")
    table.add_column("used as", overflow="fold")
    for topic in found.topics:
        table.add_row(
            escape(topic.topic),
            escape(topic.type.replace("/msg/", "/")),
            str(topic.count),
            _number(topic.rate_hz, 1),
            _number(topic.longest_gap_s, 3),
            f"{topic.first_s:.2f} … {topic.last_s:.2f}",
            _number(topic.clock_difference_s, 3),
            "×".join(map(str, topic.size_px)) if topic.size_px else "",
            topic.role or "–",
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _verdict(found: Inspection, write_map: Path | None) -> list[str]:
    from rich.markup import escape

    from tiptrace.config import dump_yaml

    lines = []
    if found.attachments:
        names = ", ".join(f"{name} ({size} B)" for name, size in found.attachments.items())
        lines.append(escape(f"attachments: {names}"))
    lines += [f"[yellow]note:[/] {escape(note)}" for note in found.notes]
    lines += [f"[red]problem:[/] {escape(problem)}" for problem in found.problems]
    if found.proposed_map is not None and write_map is None:
        lines += [
            "",
            "proposed map (--write-map map.yaml writes it; read it over):",
            escape(dump_yaml(found.proposed_map)),
        ]
    path = escape(shlex.quote(str(found.path)))
    if not found.usable:
        lines.append("[bold red]not usable as it is[/]")
    elif found.own_format:
        lines.append(f"[bold green]usable[/]: tiptrace reconstruct {path} --out results")
    else:
        name = escape(shlex.quote(str(write_map or "map.yaml")))
        lines.append(
            f"[bold green]usable[/] with a map and a rig file: tiptrace reconstruct {path} --map {name} "
            "--rig rig.yaml --reference-frames 0:20 --out results"
        )
    return lines
