"""Texts for users that another program can say in another language."""

from __future__ import annotations

import numbers
from typing import Any, Self


class Told(str):
    """An English text that knows what it was made of; wherever it is printed or written it is a `str` as any other.

    Args:
        template: the text, with places in braces where there are values for them; what can be translated.
        values: what is put into the places. One that is `Told` itself is translated by itself.
    """

    template: str
    values: dict[str, object]

    def __new__(cls, template: str, /, **values: object) -> Self:
        text = super().__new__(cls, template.format(**values) if values else template)
        text.template, text.values = template, values
        return text

    @classmethod
    def from_json(cls, told: Any) -> Self:
        """What `to_json` was made of; of another version, which wrote no more, the text as it is.

        Raises:
            KeyError, TypeError, ValueError: `told` is of something else, or a number in it was none and its place says
                how to write one.
        """
        if not isinstance(told, dict):
            return told if isinstance(told, cls) else cls(str(told))
        values = {name: cls.from_json(one) if isinstance(one, dict) else one for name, one in told["values"].items()}
        return cls(told["template"], **values)

    def to_json(self) -> dict[str, Any]:
        """`template` and `values`, of which another program makes the same text, or its translation.

        Numbers stay numbers, for a template may say how they are written; texts that are told are as this one; all else
        is text.
        """
        return {"template": self.template, "values": {name: _plain(value) for name, value in self.values.items()}}


def _plain(value: object) -> Any:
    if isinstance(value, Told):
        return value.to_json()
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return str(value)
    return int(value) if isinstance(value, numbers.Integral) else float(value)
