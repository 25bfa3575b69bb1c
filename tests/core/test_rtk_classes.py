"""ITK-RTK's classes without the rest of ITK: the same ones, sooner."""

import subprocess
import sys

import numpy as np
import pytest

from insideout.core import rtk_classes
from insideout.core.rtk_classes import rtk_class

USED = [
    ("ThreeDCircularProjectionGeometry", 0),
    ("DisplacedDetectorImageFilter", 1),
    ("ParkerShortScanImageFilter", 1),
    ("FDKConeBeamReconstructionFilter", 1),
    ("SARTConeBeamReconstructionFilter", 2),
    ("JosephForwardProjectionImageFilter", 2),
]


def loaded_by(code: str) -> set[str]:
    """Modules of ITK that a process of its own has loaded after `code`."""
    code = f"import sys; sys.path[:] = {sys.path!r}; {code}; print(*(m for m in sys.modules if m.startswith('itk.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_nothing_is_loaded_that_rtk_does_not_need() -> None:
    """Registration and thresholds are, by ITK's own loader; FDK, which transforms, does without them."""
    used = f"from insideout.core.rtk_classes import rtk_class; [rtk_class(*one) for one in {USED!r}]"
    modules = loaded_by(used)
    assert "itk._RTKPython" in modules
    assert not {"itk._ITKRegistrationCommonPython", "itk._ITKThresholdingPython"} & modules


@pytest.mark.parametrize(("name", "images"), USED)
def test_where_itk_keeps_them_elsewhere_its_loader_finds_the_same(
    name: str, images: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = rtk_class(name, images)
    assert usual.__name__ == f"rtk{name}{'IF3' * images}"

    def gone(module: str) -> None:
        raise ImportError(module)

    monkeypatch.setattr(rtk_classes, "import_module", gone)
    found = rtk_class.__wrapped__(name, images)
    # The geometry is no template; the loader wraps it all the same.
    assert type(found.New()) is type(usual.New())


def reconstructed_with(what: str) -> np.ndarray:
    """Values of a small FDK of noise in a process of its own, which has loaded "all" of ITK, or "some" of it."""
    code = """
import numpy as np, itk, sys
if sys.argv[1] == "all":
    itk.RTK.ThreeDCircularProjectionGeometry
from insideout.core.rtk_classes import rtk_class
ramp = rtk_class("FDKConeBeamReconstructionFilter", 1).New()
geometry = rtk_class("ThreeDCircularProjectionGeometry").New()
for angle in range(0, 360, 45):
    geometry.AddProjection(100.0, 150.0, float(angle))
ramp.SetGeometry(geometry)
stack = itk.image_from_array(np.random.default_rng(0).normal(size=(8, 16, 16)).astype(np.float32))
stack.SetOrigin([-7.5, -7.5, 0.0])
empty = itk.image_from_array(np.zeros((8, 8, 8), np.float32))
empty.SetOrigin([-3.5, -3.5, -3.5])
ramp.SetInput(0, empty)
ramp.SetInput(1, stack)
ramp.Update()
print(itk.array_from_image(ramp.GetOutput()).tobytes().hex())
"""
    whole = f"import sys; sys.path[:] = {sys.path!r}\n{code}"
    done = subprocess.run([sys.executable, "-c", whole, what], capture_output=True, text=True, check=True)
    return np.frombuffer(bytes.fromhex(done.stdout.strip()), np.float32)


def test_projections_are_transformed_without_all_of_itk() -> None:
    """The ramp filter needs a Fourier transform that ITK registers beside modules that are left out."""
    assert np.abs(reconstructed_with("some")).max() > 0


@pytest.mark.slow
def test_they_are_transformed_as_with_all_of_it() -> None:
    np.testing.assert_array_equal(reconstructed_with("some"), reconstructed_with("all"))
