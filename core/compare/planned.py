"""Which rows a comparison makes of a capture, which of them are still to come, and which nobody asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..capture.model import Capture
from ..settings import Settings
from .ablation import ablation_of
from .cells import Figures
from .methods import METHODS, Method, choose_methods, without_repeats
from .options import CompareSettings
from .thinning import THINNED


@dataclass(frozen=True)
class Plan:
    """The rows of one capture, in the order in which they are made.

    Attributes:
        methods: the InsideOut row before the others, whose time it sets.
        aligned: whether the alignment is measured then.
        ablation: none where there is nothing to measure it against.
        thinned: rows with fewer projections, by their number.
        possible: names of all methods that the capture allows, asked for or not.
    """

    methods: list[Method]
    aligned: bool
    ablation: list[Method]
    thinned: dict[int, list[Method]]
    possible: list[str]

    @property
    def labels(self) -> list[str]:
        """What `tables.md` calls the rows until they are there."""
        return [
            *(method.label for method in self.methods),
            *([ALIGNMENT] if self.aligned else []),
            *(ablated(method) for method in self.ablation),
            *(with_fewer(count, method) for count, rows in self.thinned.items() for method in rows),
        ]


ALIGNMENT = "the alignment"


def ablated(method: Method) -> str:
    """What a row of the ablation is called until it is there."""
    return f"ablation, {method.label}"


def with_fewer(count: int, method: Method) -> str:
    """What a row with fewer projections is called until it is there."""
    return f"{count} projections, {method.label}"


def plan_of(capture: Capture, methods: Sequence[Method], options: CompareSettings, settings: Settings) -> Plan:
    """The rows of a capture.

    Args:
        methods: those of the comparison.
        options, settings: the comparison's, and the preset that methods change.

    Raises:
        SettingError: a row of the ablation that was asked for cannot be; see `ablation_of`.
    """
    rows = [method for method in methods if method.reason_not_for(capture) is None]
    rows = sorted(rows, key=lambda method: method.name != "insideout")
    ablation = ablation_of(settings, capture, options.ablation_rows)
    has_inside = capture.projections is not None or capture.volume is not None or has_truth(capture)
    whole = has_inside and any(method.name == "insideout" for method in rows)
    allowed = without_repeats(choose_methods((), [capture]), settings)
    # Without photos a row with all projections is the method's own row.
    numbers = [count for count in options.projections if capture.photos is not None or count != _trained_on(capture)]
    return Plan(
        methods=rows,
        aligned=whole and capture.photos is not None,
        ablation=ablation if whole and options.ablation else [],
        thinned={count: [method for method in rows if method.name in THINNED] for count in numbers},
        possible=[method.name for method in allowed],
    )


def _trained_on(capture: Capture) -> int:
    return 0 if capture.projections is None else int((~capture.projections.held_out).sum())


def has_truth(capture: Capture) -> bool:
    """Whether the capture's folder tells what is true of it."""
    return (capture.path / "truth.npz").exists()


def rows_not_run(capture: Figures) -> list[str]:
    """Labels of the methods that the capture allows and that have no row in its figures, of `tables.json`."""
    missing = [name for name in capture.get("possible") or [] if name not in capture["methods"]]
    return [METHODS[name].label for name in missing if name in METHODS]
