"""A table with units in its columns, as CSV, JSON, Markdown, LaTeX or HTML cells."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tiptrace.evaluation.atomic import write_atomic

MISSING = "–"

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class Column:
    """One column: machine name for CSV and JSON, heading with its unit for readers, digits after the point."""

    name: str
    heading: str
    digits: int = 2


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of plain values under named columns.

    Attributes:
        name: File name without suffix.
        title: Caption.
        columns: Columns in order.
        rows: Values in the order of the columns; NaN and None are shown as a dash.
        note: What a reader must know to read it.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def text_rows(self) -> list[list[str]]:
        """Rows as a reader sees them."""
        return [[show(v, c.digits) for v, c in zip(row, self.columns, strict=True)] for row in self.rows]

    def is_text(self, column: int) -> bool:
        """Whether a column holds words, which stand to the left; numbers, with their doubt too, to the right."""
        cells = [row[column] for row in self.rows]
        return any(isinstance(c, str) and c[:1].isalpha() for c in cells)

    def csv(self) -> str:
        """CSV with machine names and full precision; unknown values are empty."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow([c.name for c in self.columns])
        writer.writerows([["" if (k := _known(v)) is None else k for v in row] for row in self.rows])
        return buffer.getvalue()

    def records(self) -> list[dict[str, Any]]:
        """Rows as mappings with machine names; unknown values are None."""
        return [{c.name: _known(v) for c, v in zip(self.columns, row, strict=True)} for row in self.rows]

    def markdown(self) -> str:
        """GitHub table with its title and note."""
        rows = [[_escape_markdown(cell) for cell in row] for row in self.text_rows()]
        lines = [
            f"**{self.title}**",
            "",
            "| " + " | ".join(_escape_markdown(c.heading) for c in self.columns) + " |",
            "|" + "|".join(" :--- " if self.is_text(k) else " ---: " for k in range(len(self.columns))) + "|",
            *("| " + " | ".join(row) + " |" for row in rows),
        ]
        return "\n".join([*lines, *(["", self.note] if self.note else []), ""])

    def latex(self) -> str:
        r"""A ``table`` environment for ``booktabs`` and ``graphicx``; too wide a table is made to fit."""
        rows = [" & ".join(_escape_latex(cell) for cell in row) + r" \\" for row in self.text_rows()]
        kinds = "".join("l" if self.is_text(k) else "r" for k in range(len(self.columns)))
        head = " & ".join(rf"\textbf{{{_escape_latex(c.heading)}}}" for c in self.columns) + r" \\"
        return "\n".join(
            [
                r"\begin{table}[t]",
                r"  \centering",
                rf"  \caption{{{_escape_latex(self.title)}}}",
                rf"  \label{{tab:{self.name.replace('_', '-')}}}",
                r"  \resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
                rf"  \begin{{tabular}}{{{kinds}}}",
                r"    \toprule",
                f"    {head}",
                r"    \midrule",
                *(f"    {row}" for row in rows),
                r"    \bottomrule",
                r"  \end{tabular}}",
                *([f"  % {self.note}"] if self.note else []),
                r"\end{table}",
                "",
            ]
        )


def show(value: Cell, digits: int = 2) -> str:
    """A value as a reader sees it."""
    known = _known(value)
    if known is None:
        return MISSING
    return f"{known:.{digits}f}" if isinstance(known, float) else str(known)


def show_p(p: float) -> str:
    """A p value: tiny ones as a bound."""
    if math.isnan(p):
        return MISSING
    return "< 0.001" if p < 1e-3 else f"{p:.3f}"


def show_interval(low: float, high: float, digits: int = 2) -> str:
    """An interval with its ends."""
    return MISSING if math.isnan(low) else f"[{low:.{digits}f}, {high:.{digits}f}]"


def mean_std(mean: float, std: float, digits: int = 2) -> str:
    """Mean ± std; without a spread the mean alone."""
    if math.isnan(mean):
        return MISSING
    return f"{mean:.{digits}f}" + ("" if math.isnan(std) else f" ± {std:.{digits}f}")


def write_tables(folder: Path, tables: Sequence[Table]) -> None:
    """Write each table as ``NAME.csv`` and ``NAME.tex``, all together as ``tables.json`` and ``tables.md``.

    Raises:
        OutputError: a file cannot be written.
    """
    for table in tables:
        write_atomic(folder / f"{table.name}.csv", table.csv())
        write_atomic(folder / f"{table.name}.tex", table.latex())
    together = {t.name: {"title": t.title, "note": t.note, "rows": t.records()} for t in tables}
    write_atomic(
        folder / "tables.json", json.dumps(together, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    )
    write_atomic(folder / "tables.md", "\n".join(t.markdown() for t in tables))


def columns(*named: tuple[str, str] | tuple[str, str, int]) -> tuple[Column, ...]:
    """Columns from (name, heading) or (name, heading, digits)."""
    return tuple(Column(*entry) for entry in named)


def rows_of(rows: Iterable[Iterable[Cell]]) -> tuple[tuple[Cell, ...], ...]:
    """Rows as a table holds them."""
    return tuple(tuple(row) for row in rows)


def _known(value: Cell) -> Cell:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _escape_markdown(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "±": r"$\pm$", "ρ": r"$\rho$",
    "σ": r"$\sigma$", "–": "--", "−": "$-$", "…": r"\ldots{}", "°": r"\textdegree{}",
}  # fmt: skip


def _escape_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
