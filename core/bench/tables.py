"""Measurements as tables, for a terminal or a Markdown file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

FORETOLD_WITHIN = 0.3
"""How far a forecast may be off, as a share of what the run took."""
LATEST = 0.1
"""How much later than its budget a run may end, as a share of that."""
_WIDEST = 1000


@dataclass(frozen=True)
class Column:
    """A heading and how a row is written under it.

    Attributes:
        short: the heading in a terminal, "" for a column that only Markdown shows.
    """

    heading: str
    text: Callable[[dict[str, Any]], str]
    short: str | None = None


@dataclass(frozen=True)
class Table:
    """A title, columns and rows."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[dict[str, Any]]

    def cells(self) -> list[list[str]]:
        """The texts, row by row."""
        return [[column.text(row) for column in self.columns] for row in self.rows]

    def markdown(self) -> str:
        lines = [f"**{self.title}**", "", self._line([column.heading for column in self.columns])]
        lines.append(self._line(["---"] * len(self.columns)))
        return "\n".join([*lines, *(self._line(cells) for cells in self.cells())])

    def show(self, console: Console) -> None:
        shown = [column for column in self.columns if column.short != ""]
        table = RichTable(
            title=self.title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
        )
        for column in shown:
            table.add_column(column.short or column.heading, justify="right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(column.text(row) for column in shown))
        # Cells that are cut off tell nothing: in a narrow terminal, or a file, lines are rather too long.
        before = console.width
        console.width = max(console.measure(table, options=console.options.update(max_width=_WIDEST)).maximum, before)
        try:
            console.print(table)
        finally:
            console.width = before

    @staticmethod
    def _line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cells)} |"


def number(key: str, form: str, factor: float | None = None) -> Callable[[dict[str, Any]], str]:
    """A row's number under `key`, times a factor if there is one; empty where the row has none."""

    def text(row: dict[str, Any]) -> str:
        value = row.get(key)
        return "" if value is None else format(value if factor is None else value * factor, form)

    return text


def brief(count: int) -> str:
    """5e4 for 50,000, all digits for what is not that round."""
    text = f"{count:.0e}".replace("e+0", "e")
    return text if float(text) == count else f"{count:,d}"


def kernels_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("renderer", lambda row: row["renderer"]),
        Column("kernel", lambda row: row["kernel"], short="" if len({row["kernel"] for row in rows}) < 2 else None),
        Column("splats", lambda row: brief(row["splats"])),
        Column("image", lambda row: f"{row['width']}x{row['height']}"),
        Column("threads", number("threads", "d"), short="thr"),
        Column("project ms", number("project_ms", ".1f"), short="proj"),
        Column("sort ms", number("sort_ms", ".1f"), short="sort"),
        Column("forward ms", number("forward_ms", ".1f"), short="forw"),
        Column("backward ms", number("backward_ms", ".1f"), short="back"),
        Column("step ms", number("step_ms", ".1f"), short="step"),
        Column("processor ms", number("cpu_ms", ".1f"), short=""),
        Column("1e6 pixel-splats/s", number("pixel_splats_per_s", ".0f", 1e-6), short="1e6/s"),
        Column("peak GFLOP/s", number("peak_gflops", ".0f"), short=""),
        Column("share of peak", number("peak_share", ".0%"), short="peak"),
    ]
    kernel = rows[0]["kernel"] if rows else "cpu"
    return Table(f"A step on the {kernel} kernel: ms, pixel-splats a second, share of the peak", columns, rows)


def growth_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("renderer", lambda row: row["renderer"]),
        Column("from", lambda row: f"{row['low']:,d} {row['by']}"),
        Column("to", lambda row: f"{row['high']:,d} {row['by']}"),
        Column("growth", lambda row: f"x {row['high'] / row['low']:.1f}"),
        Column("time of a step", lambda row: f"x {row['times']:.2f}"),
    ]
    return Table("Growth of a step's time", columns, rows)


def training_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("kernel", lambda row: row["kernel"]),
        Column("splats", number("splats", ",d")),
        Column("photos", lambda row: f"{row['photos']} of {row['side']} x {row['side']}"),
        Column("iterations", number("iterations", "d")),
        Column("seconds", number("seconds", ".1f")),
        Column("held-out dB", number("heldout_psnr", ".2f")),
        Column("in the kernels", number("kernel_share", ".0%")),
    ]
    return Table("Training", columns, rows)


def shares_table(share: dict[str, float]) -> Table:
    rows = [{"part": part, "share": value} for part, value in sorted(share.items(), key=lambda item: -item[1])]
    columns = [Column("part of a step", lambda row: row["part"]), Column("share of time", number("share", ".1%"))]
    return Table("Where a training step's time goes", columns, rows)


def memory_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("renderer", lambda row: row["renderer"]),
        Column("splats", number("splats", ",d")),
        Column("image", lambda row: f"{row['width']} x {row['height']}"),
        Column("with the scene, MB", number("before_mb", "d")),
        Column("most, MB", number("peak_mb", "d")),
    ]
    return Table("Memory of a forward and backward pass", columns, rows)


def agreement_table(rows: Sequence[dict[str, Any]], kernel: str) -> Table:
    columns = [
        Column("renderer", lambda row: row["renderer"]),
        Column("parameter", lambda row: row["parameter"]),
        Column("scenes", number("scenes", "d")),
        Column("median", number("median", ".1e")),
        Column("95 %", number("percentile95", ".1e")),
        Column("largest", number("largest", ".1e")),
        Column("worst scene", number("worst_scene", "d"), short="scene"),
        Column("over 1e-4", number("over_value_bar", "d"), short=">1e-4"),
        Column("over 1e-3", number("over_gradient_bar", "d"), short=">1e-3"),
        Column("bar", number("bar", ".0e"), short=""),
        Column("over the bar", number("over_bar", "d"), short=""),
    ]
    return Table(f"Relative errors of the image and of the gradient by each parameter, {kernel} kernel", columns, rows)


def affine_times_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("mode", lambda row: row["mode"]),
        Column("splats", lambda row: brief(row["splats"])),
        Column("image", lambda row: f"{row['width']}x{row['height']}"),
        Column("forward ms", number("forward_ms", ".1f")),
        Column("backward ms", number("backward_ms", ".1f")),
        Column("step ms", number("step_ms", ".1f")),
        Column("differs from exact", number("image_error", ".1e")),
    ]
    return Table("A step of the radiograph in both modes", columns, rows)


def affine_errors_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("σ / distance from the source", number("sigma", "g"), short="σ / distance"),
        Column("beside the axis / distance", number("place", "g"), short="beside / distance"),
        Column("largest error / peak", number("peak_error", ".1e"), short="error / peak"),
        Column("error of the whole", number("total_error", ".1e"), short="of the whole"),
    ]
    return Table("What the affine mode errs by for one ball", columns, rows)


def options_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("half", lambda row: row["half"]),
        Column("options", lambda row: row["options"]),
        Column("iterations", number("iterations", "d")),
        Column("seconds", number("seconds", ".1f")),
        Column("processor s", number("cpu_seconds", ".1f")),
        Column("splats", number("splats", ",d")),
        Column("held-out dB", number("heldout_psnr", ".2f")),
    ]
    return Table("Options that save steps", columns, rows)


def cuts_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("of", lambda row: row["of"]),
        Column("splats", lambda row: brief(row["splats"])),
        Column("section", lambda row: f"{row['width']}x{row['height']}"),
        Column("prepared once, ms", number("prepare_ms", ".0f"), short="once ms"),
        Column("exact, ms", number("exact_ms", ".1f"), short="exact ms"),
        Column("while it moves, ms", number("moving_ms", ".1f"), short="move ms"),
        Column("updates a second", number("updates", ".1f"), short="per s"),
        Column("RMS difference / peak", number("rms_difference", ".1e"), short="RMS diff"),
        Column("largest difference / peak", number("largest_difference", ".1e"), short="most diff"),
    ]
    return Table("The section that follows a plane in Blender, numpy alone, mean over its places", columns, rows)


def foretold_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("capture", lambda row: row["capture"]),
        Column("preset", lambda row: row["preset"]),
        Column("foretold, s", number("foretold_s", ".0f")),
        Column("taken, s", number("seconds", ".0f")),
        Column("off", number("off", "+.0%")),
        Column("", lambda row: "cameras had to be found" if row["cameras"] else "", short=""),
    ]
    within = sum(abs(row["off"]) <= FORETOLD_WITHIN for row in rows)
    return Table(f"{within} of {len(rows)} runs took what was foretold within {FORETOLD_WITHIN:.0%}", columns, rows)


def budgets_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("capture", lambda row: row["capture"]),
        Column("preset", lambda row: row["preset"]),
        Column("its time is the budget, s", number("budget_s", ".0f")),
        Column("taken, s", number("seconds", ".0f")),
        Column("late", number("late", "+.0%")),
        *(Column(f"{kind}: preset, in its time, dB", partial(_beside, kind)) for kind in ("photos", "projections")),
    ]
    late = sum(row["late"] > LATEST for row in rows)
    return Table(f"{late} of {len(rows)} runs ended more than {LATEST:.0%} after their budget", columns, rows)


def _beside(kind: str, row: dict[str, Any]) -> str:
    return ", ".join("–" if value is None else f"{value:.1f}" for value in row[kind])


def reached_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("capture", lambda row: row["capture"]),
        Column("preset", lambda row: row["preset"]),
        Column("photos, dB", number("photos", ".1f")),
        Column("projections, dB", number("projections", ".1f")),
    ]
    return Table("What presets reached of what was kept back", columns, rows)


def weights_table(rows: Sequence[dict[str, Any]]) -> Table:
    columns = [
        Column("body", lambda row: row["body"]),
        Column("weighed from", lambda row: row["weighed"], short="from"),
        Column("mass, g", number("mass_g", ".3f")),
        Column("found, g", number("found_g", ".3f")),
        Column("off", number("off", "+.2%")),
        Column("centre off, mm", number("center_off_mm", ".3f"), short="centre, mm"),
        Column("inertia off", number("inertia_off", ".2%"), short="inertia"),
        Column("cavities, mm³", _volumes("cavities_mm3")),
        Column("found, mm³", _volumes("cavities_found_mm3"), short="found"),
        Column("worst one off", number("cavity_off", "+.2%"), short="worst"),
        Column("processor s", number("cpu_seconds", ".1f"), short="s"),
    ]
    return Table("Weighed where the truth is known", columns, rows)


def _volumes(key: str) -> Callable[[dict[str, Any]], str]:
    """The sum of a row's volumes under `key` and how many they are; empty where there are none."""

    def text(row: dict[str, Any]) -> str:
        volumes = row.get(key) or ()
        total = f"{sum(volumes):,.0f}" if volumes else ""
        return f"{total} in {len(volumes)}" if len(volumes) > 1 else total

    return text
