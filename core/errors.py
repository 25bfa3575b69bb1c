"""Errors a user can cause: one sentence that names the file or setting, what is wrong, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .told import Told


class InsideOutError(Exception):
    """Base of every error shown to the user without a traceback; the command line exits with code 2.

    Args:
        template: the sentence, with places in braces where there are values for them; what can be translated.
        values: what is put into the places.
    """

    def __init__(self, template: str, /, **values: object) -> None:
        values = {name: _kept(value) for name, value in values.items()}
        super().__init__(template.format(**values) if values else template)
        self.template, self.values = template, values

    @property
    def text(self) -> Told:
        """Its sentence, with what it was made of."""
        return Told(self.template, **self.values)

    def told(self) -> dict[str, Any]:
        """Its sentence as `Told.to_json`."""
        return self.text.to_json()


class CaptureError(InsideOutError):
    """Something in the capture folder is missing, unreadable or contradicts itself."""


class SettingError(InsideOutError):
    """A setting or a command-line option is out of range or does not fit the capture."""


class GaussianFileError(InsideOutError):
    """A Gaussian .ply file cannot be read, or a field of it is missing."""


class MeshFileError(InsideOutError):
    """A mesh file cannot be read, or holds nothing that can be used."""


class RunFolderError(InsideOutError):
    """The run folder belongs to another capture, is damaged, or cannot be written."""


class DiskFullError(RunFolderError):
    """No space is left for what is being written; what was there before is untouched."""


class Cancelled(Exception):
    """The user asked to stop. Not an error: checkpoints are kept and the run can be resumed."""


def check_choices(settings: object, choices: Mapping[str, Sequence[str]]) -> None:
    """Of fields of `settings` those that have two values or more to choose from.

    Raises:
        SettingError: one has another.
    """
    for name, accepted in choices.items():
        value = getattr(settings, name)
        if value not in accepted:
            listed = Told("{names} or {last}", names=", ".join(accepted[:-1]), last=accepted[-1])
            raise SettingError("{name} is {value}; choose {choices}.", name=name, value=repr(value), choices=listed)


def _kept(value: object) -> object:
    """As a value another error would keep alive what its traceback holds, and few of them can be pickled."""
    if isinstance(value, InsideOutError):
        return value.text
    return str(value) if isinstance(value, BaseException) else value
