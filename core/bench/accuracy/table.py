"""The rows of `insideout bench accuracy` as a table: what each position costs and brings, beside the preset."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..machine import where
from ..tables import Column, Table

_FRAME = ("scale_percent", "rotation_deg", "translation_mm")


def accuracy_table(content: dict[str, Any]) -> Table:
    """Of the content of `accuracy.json`; differences are to its first row, the preset that knobs are turned from."""
    rows = content["rows"]
    usual = rows[0] if rows else {}
    truth = content["truth"]
    # Files of before it was told apart are of captures whose attenuation is known.
    true = "true" if content.get("exact", truth is not None) else f"against {truth or 'the FDK'}"
    columns = [
        Column("knob", lambda row: str(row["knob"])),
        Column("position", lambda row: str(row["value"])),
        Column("seconds", lambda row: f"{row['seconds']:.0f}"),
        Column("seconds more", _difference("seconds", usual, ".0f"), "more s"),
        Column(f"sections dB ({true})", _value("sections"), "sections"),
        Column("sections: dB more", _difference("sections", usual, ".2f"), "more"),
        Column("photos dB", _value("photos"), "photos"),
        Column("photos: dB more", _difference("photos", usual, ".2f"), "more"),
        Column("projections dB", _value("projections"), "projections"),
        Column("frame off: scale %, rotation °, mm", _frame, "frame: %, °, mm"),
    ]
    made_on = {where(row["machine"]) for row in rows if row.get("machine")}
    if len(made_on) > 1:
        columns.append(Column("made on", lambda row: where(row["machine"]) if row.get("machine") else "–"))
    return Table(f"What accuracy costs: {content['capture']}, preset {content['preset']}", columns, rows)


def presets_table(content: dict[str, Any]) -> Table:
    """Of the content of `accuracy.json`: what presets have, beside the best of what was measured in half of their time,
    in all of it and in twice as much. A preset that is a knee is much better than the best in half of its time, and
    nearly as good as the best in twice as much. Rows with fewer photos or projections are of other captures."""
    rows = [row for row in content["rows"] if row["knob"] not in ("photos", "projections")]
    kinds = [kind for kind in ("sections", "photos", "projections") if rows and rows[0].get(kind) is not None]
    shown = [{**row, "kind": kind} for row in rows if row["knob"] == "preset" for kind in kinds]
    columns = [
        Column("preset", lambda row: str(row["value"])),
        Column("seconds", lambda row: f"{row['seconds']:.0f}"),
        Column("dB of", lambda row: str(row["kind"])),
        Column("its own", lambda row: f"{row[row['kind']]:.2f}"),
        Column("best in half of its time", _best_within(rows, 0.5), "in half"),
        Column("in its time", _best_within(rows, 1.0), "in all"),
        Column("in twice its time", _best_within(rows, 2.0), "in twice"),
    ]
    return Table("Presets, and what else was measured", columns, shown)


def _best_within(rows: list[dict[str, Any]], times: float) -> Callable[[dict[str, Any]], str]:
    def text(row: dict[str, Any]) -> str:
        kind, known = row["kind"], [one for one in rows if one["seconds"] <= times * row["seconds"]]
        if not known:
            return "–"
        best = max(known, key=lambda one: float(one[kind]))
        return f"{best[kind]:.2f}, {best['knob']} {best['value']}"

    return text


def _value(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "–" if row.get(name) is None else f"{row[name]:.2f}"


def _difference(name: str, usual: dict[str, Any], form: str) -> Callable[[dict[str, Any]], str]:
    def text(row: dict[str, Any]) -> str:
        if row is usual or row.get(name) is None or usual.get(name) is None:
            return "–"
        return f"{row[name] - usual[name]:+{form}}"

    return text


def _frame(row: dict[str, Any]) -> str:
    return ", ".join(f"{row[name]:.2f}" for name in _FRAME) if all(name in row for name in _FRAME) else "–"
