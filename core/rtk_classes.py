"""ITK-RTK's classes, each loaded without the rest of ITK: that takes a third of the time."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any


def load() -> None:
    """Loads ITK-RTK, which takes some seconds the first time in a process."""
    rtk_class("ThreeDCircularProjectionGeometry")


@cache
def rtk_class(name: str, images: int = 0) -> Any:
    """The class `name` of RTK's for float images in 3D.

    `itk.RTK` first loads whatever a module depends on that RTK depends on, a hundred shared libraries, registration
    and thresholds among them: 20 s where its own take 6. So the class is taken from where ITK's loader takes it in the
    end. Where another version of ITK keeps it elsewhere, the loader finds it.

    Args:
        images: how many image types the class is a template over.
    """
    import itk

    with _nothing_collected():
        try:
            _register_fft()
            return getattr(import_module(f"itk.rtk{name}Python"), f"rtk{name}{'IF3' * images}")
        except (ImportError, AttributeError):
            whole = getattr(itk.RTK, name)
            return whole[(itk.Image[itk.F, 3],) * images] if images else whole


@cache
def _register_fft() -> None:
    """What the ramp filter transforms with; ITK's loader registers it beside the module that RTK would draw in."""
    factory = import_module("itk.itkVnlFFTImageFilterInitFactoryPython").itkVnlFFTImageFilterInitFactory
    factory.RegisterOneFactory()


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """Looking for garbage again and again among the tens of thousands of objects that arrive took a fourth of the
    time, and there is none."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
