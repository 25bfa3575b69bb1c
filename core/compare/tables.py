"""The paper's four tables as Markdown, each of ours beside the paper's own figures."""

from __future__ import annotations

from ..bench.machine import where
from .against import measured_against, still_to_come
from .alignment_table import alignment_table
from .cells import Figures
from .detail import detail_table
from .how import how_measured
from .mesh_tables import mesh_tables
from .row_tables import ablation_table, fewer_projections, time_table
from .short import in_short


def markdown(content: Figures) -> str:
    """`tables.md` of the content of `tables.json`; figures that an earlier version did not measure are left out."""
    captures = content["captures"]
    parts = [
        "# The paper's tables",
        still_to_come(content),
        _head(content),
        _machines(content),
        in_short(captures, content["same_time"]),
        measured_against(content),
        detail_table(captures),
        alignment_table(captures),
        mesh_tables(captures),
        ablation_table(captures),
        fewer_projections(captures),
        time_table(captures),
        how_measured(content),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _head(content: Figures) -> str:
    version = f"InsideOut {content['version']}, preset" if content.get("version") else "Preset"
    return f"{version} `{content['preset']}`, seed {content['seed']}, kernel `{content['kernel']}`."


def _machines(content: Figures) -> str:
    """On which machines rows were measured, and when; each capture on its own line where those are not the same."""
    found = {name: _places(one, content["machine"]) for name, one in content["captures"].items()}
    if len(set(found.values())) <= 1:
        return f"{next(iter(found.values()), where(content['machine']))}."
    return "\n".join(f"- {name}: {line}" for name, line in found.items())


def _places(capture: Figures, otherwise: Figures) -> str:
    thinned = [row for rows in capture["projections"].values() for row in rows.values()]
    rows = [*capture["methods"].values(), *capture["ablation"].values(), *thinned]
    known = [row["machine"] for row in rows if row.get("machine")] or [capture.get("machine") or otherwise]
    dates: dict[str, list[str]] = {}
    for facts in known:
        dates.setdefault(where(facts), []).append(facts["date"])
    return "; ".join(
        f"{min(when)}, {found}" if len(set(when)) == 1 else f"{min(when)} to {max(when)}, {found}"
        for found, when in dates.items()
    )
