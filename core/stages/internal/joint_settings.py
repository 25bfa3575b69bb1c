"""How the joint refinement is done: its settings, and those of the presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ...capture.model import Capture
from ...train.schedule import Decay, in_iterations
from ...train.smoothness import EDGE


@dataclass(frozen=True)
class JointSettings:
    """How the two halves become one model.

    Rates are those of Adam; means and the similarity's shift are multiplied by half the longest side of the box.

    Attributes:
        iterations: each one photo, some also a projection or a section.
        share_alone: of the iterations, those that there are without photos, each one projection.
        photo_weight, projection_weight, section_weight: of the three losses. Sections move opacities alone, towards
            the material of the volume, but for its skin, which photos see: the attenuation of an FDK is that of the
            projections already.
        structure_weight: λs of photos and sections.
        squares_weight, straight_from, radiograph_structure_weight: of projections, as in `surface`, whose full scale
            is "body".
        smooth_weight, smooth_edge, smooth_voxels, smooth_every: roughness of a block of voxels, as in `surface`;
            `smooth_every` counts projections. The weight is multiplied by `smooth_share`, what `surface` found good.
        xray_every: iterations from one projection to the next. Radiative splats come here fitted, and their colours
            have still to be learnt. Their shape and density have steps of Adam of their own, one with each projection
            and its smoothness. What photos move as well (`photos_shape_xray`, `photos_attenuate`) has common steps,
            in which the projection's weight makes up for the pause. Without photos every iteration shows one.
        section_every: iterations from one section to the next; its weight makes up for the pause.
        section_until: fraction of the iterations after which there are no sections: photos have the rest to themselves.
        memory: how much Adam keeps of the mean of squared gradients (β₂) in the steps of what projections alone move,
            as in `surface`.
        cutoff_sigmas: where a splat ends in sections and blocks of voxels while it is trained.
        ray_cutoff_sigmas: where it ends in projections; as in sections if None. Ended at 3, densities become 0.7 % too
            large for whole splats (`XraySettings.whole`), by which projections that were kept back lose 0.4 to 0.7 dB;
            from 4 on nothing more is gained.
        photo_size: long side of the photos in pixels.
        shown_at_surface: display opacities start so low that no radiative splat shows more than this at the surface:
            many overlap there, and photos take long to make them clear again.
        photos_attenuate: photo splats learn densities, too. They are thin sheets: on the Matryoshka it cost held-out
            projections 1.6 dB.
        least_pixels: lower limit of the radiative splats' scales in detector pixels at the object, as in `surface`.
        frame_grows: the similarity's scale is refined, too. Photo splats and the skin of radiative ones lie a little
            under the surface that photos show, and the frame would take that for a size: it went from 0.1 % off to
            0.4 % on two phantoms, while turn and shift came nearer to the truth.
        photos_shape_xray: photos move and stretch radiative splats, too. They see such a splat's skin only, and their
            gradients are larger than those of projections: without this what lies inside stays theirs to tell. With
            it radiative splats have the rates of photo splats, and Adam's usual memory.
        means_rate, rotation_rate, scale_rate: of photo splats.
        opacity_rate, color_rate: of all splats' display opacities and DC colours; other bands have a twentieth of it.
        xray_means_rate, xray_rotation_rate, xray_scale_rate: of radiative splats.
        density_rate: of all that attenuate.
        similarity_rate: of the photo frame's rotation (rad), shift and, if `frame_grows`, logarithm of scale.
    """

    iterations: int = 1500
    share_alone: float = 1 / 3
    photo_weight: float = 1.0
    projection_weight: float = 1.0
    section_weight: float = 0.1
    structure_weight: float = 0.2
    squares_weight: float | None = 60.0
    straight_from: float | None = 0.005
    radiograph_structure_weight: float = 0.1
    smooth_weight: float = 0.01
    smooth_edge: float | None = None
    smooth_voxels: int = 32
    smooth_every: int = 2
    xray_every: int = 1
    section_every: int = 1
    section_until: float = 1.0
    memory: float = 0.999
    cutoff_sigmas: float = 3.0
    ray_cutoff_sigmas: float | None = None
    photo_size: int = 800
    shown_at_surface: float = 0.003
    photos_attenuate: bool = False
    least_pixels: float = 0.1
    photos_shape_xray: bool = False
    frame_grows: bool = False
    means_rate: Decay = Decay(2e-5, 2e-6)
    rotation_rate: Decay = Decay(1e-4, 1e-5)
    scale_rate: Decay = Decay(5e-4, 5e-5)
    opacity_rate: Decay = Decay(0.05, 0.005)
    color_rate: Decay = Decay(2e-3, 2e-4)
    xray_means_rate: Decay = Decay(2e-5, 2e-6)
    xray_rotation_rate: Decay = Decay(1e-4, 1e-5)
    xray_scale_rate: Decay = Decay(5e-4, 5e-5)
    density_rate: Decay = Decay(1e-3, 1e-4)
    similarity_rate: Decay = Decay(2e-5, 2e-6)


# What projections alone move; it comes here fitted.
_OF_XRAY = ("xray_means_rate", "xray_rotation_rate", "xray_scale_rate", "density_rate")


def joint_in_iterations(settings: JointSettings, iterations: int) -> JointSettings:
    """For more or fewer iterations, at the rates of so many, as `train.schedule.in_iterations` has it of each half.

    But what attenuates comes here fitted. In a fourth of a `draft` photos of the sample are 1.0 dB better than at the
    rates of a whole one, those of an engine 0.2 worse. With all rates photos were the same, and the engine's
    projections lost 0.2 dB; in a tenth photos of both gained 0.3, the engine's projections lost 0.4, the sample's
    gained 0.1.
    """
    return in_iterations(settings, iterations, _OF_XRAY)


# Few projections, at rates that go on from where those of `surface` end (means from half of it): 125 of them bring
# 0.1 to 0.5 dB of true sections on the five phantoms, three times as many at higher rates 0.1 more. Sections keep
# the inside solid where photos make the surface clear: a third as many cost 3 dB of the occupancy in sections,
# twice as many 0.4 dB of the photos. Photos that have the last quarter and the skin to themselves are as good as
# those of their half alone.
_STANDARD = JointSettings(
    iterations=2000,
    share_alone=0.25,
    xray_every=16,
    section_every=6,
    section_until=0.75,
    smooth_every=4,
    smooth_weight=0.1,
    smooth_edge=EDGE,
    memory=0.99,
    means_rate=Decay(4e-5, 4e-6),
    rotation_rate=Decay(1e-3, 1e-4),
    scale_rate=Decay(4e-3, 4e-4),
    xray_means_rate=Decay(2e-5, 2e-6),
    xray_rotation_rate=Decay(1e-3, 1e-4),
    xray_scale_rate=Decay(4e-3, 4e-4),
    density_rate=Decay(2e-3, 2e-4),
)

PRESETS: dict[str, JointSettings] = {
    # The radiative half of a draft is far from fitted: its rates are half of those of `surface` or as large.
    "draft": JointSettings(
        iterations=500,
        photo_size=400,
        smooth_weight=0.05,
        smooth_edge=EDGE,
        memory=0.99,
        means_rate=Decay(2e-4, 2e-5),
        rotation_rate=Decay(0.01, 0.001),
        scale_rate=Decay(0.02, 0.002),
        opacity_rate=Decay(0.1, 0.01),
        xray_means_rate=Decay(2e-4, 2e-5),
        xray_rotation_rate=Decay(0.01, 0.001),
        xray_scale_rate=Decay(0.02, 0.002),
        density_rate=Decay(0.02, 0.002),
    ),
    "standard": _STANDARD,
    "paper": replace(joint_in_iterations(_STANDARD, 6000), photo_size=1600),
}


def without_photos(settings: JointSettings) -> JointSettings:
    """For X-rays alone, which are fitted when they come here; display opacities are the sections' alone then, and
    learnt when the densities are known."""
    return replace(
        settings, iterations=math.ceil(settings.share_alone * settings.iterations), xray_every=1, section_weight=0.0
    )


def joint_of(settings: JointSettings | None, capture: Capture) -> JointSettings | None:
    """The settings of the joint refinement of a capture, None where each half is refined apart: without projections,
    and with a volume of the user's own, which densities follow."""
    return None if capture.projections is None or capture.volume is not None else settings
