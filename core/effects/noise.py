"""Counting noise: of N₀ photons N₀ e⁻ᵖ get through, and the line integral p that they tell has a variance of eᵖ/N₀.

It is measured in the projections themselves: Immerkaer's mask (Computer Vision and Image Understanding 64(2), 1996)
takes away all that is smooth. What is there whatever arrives is a constant beside it. A finding says how far noise
limits the figures, whatever the model. From 1 % of the peak on, or if asked for, a fit weighs line integrals by how
well they are known: penalized weighted least squares (Sauer and Bouman, IEEE Trans. Signal Processing 41(2), 1993), see
`core.train.losses.as_known`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, sobel
from scipy.optimize import nnls

from ..capture.model import CountingNoise, Projections
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .rays import RayEvidence, of_another_unit

_NAME, _UNIT = "noise", "% of the peak"
# From 1 % on true volumes of phantoms and real CTs gain; with half of it a real head, whose grain is the truth, lost
# 0.4 dB.
_THRESHOLD = 1.0
# 50 dB behind thick parts; held-out projections of what is well fitted have 42 dB without any noise.
_LIMITS = 0.3
# What deviates by less than that, or than such a share of what is behind thin parts, counts as known.
_KNOWN_SHARE = 1 / 3
# Views to look at, and the pixels of all of them together.
_MOST_VIEWS, _FEWEST_VIEWS, _MOST_PIXELS, _FEWEST_ROWS = 24, 4, 2_000_000, 32
# The shadow: beyond a tenth of what nearly all rays lose. Percentiles of it: thin parts and thick ones.
_SHADOW, _NEARLY_ALL = 0.1, 99.0
_THIN, _THICK = 10, 90
_BINS, _HIGHEST, _FEWEST_IN_BIN, _FEWEST_BINS = 10, 99.9, 100, 4
# Of a bin's pixels, those where the image rises least: edges answer to the mask, too.
_LEVEL_SHARE = 0.25
# Deviation of the Gaussian under which pixels are sorted by what arrives, and pixels at the border that it spoils.
_SORTED_BY_PX, _BORDER_PX = 1.5, 2
_MASK, _MASK_NORM = np.array([1.0, -2.0, 1.0]), 6.0
_TO_DEVIATION = 1.4826
# Variance of the median of 1, 2, 3, ... normal numbers of variance 1, by quadrature of the density of those in the
# middle (David and Nagaraja, Order Statistics, 2003).
_OF_MEDIANS = (
    *(1.0, 0.5, 0.4487, 0.2982, 0.2868, 0.2147, 0.2104, 0.1682, 0.1661, 0.1383, 0.1372, 0.1175),
    *(0.1168, 0.1022, 0.1017, 0.0904, 0.0900, 0.0810, 0.0808, 0.0734, 0.0733, 0.0671, 0.0670),
)
# Of the peak, what float16 leaves of a line integral.
_NOTHING = 1e-4
# Of the variance that is nothing: as many times are something, whatever float16 does.
_CLEARLY = 25.0
# Relative standard error of the square of a median deviation of n independent numbers, times the root of n.
_OF_SQUARE = 2.33
# Cauchy's weights are half at so many standard errors.
_CAUCHY, _ROUNDS = 2.4, 30


def detect(evidence: RayEvidence) -> EffectFinding:
    """Deviation of the noise behind thick parts, the 90th percentile of the shadow, in percent of the largest value.

    Looked at in full size, where blocks of pixels would have less of it.

    `numbers`: those of `CountingNoise`; none where there is no noise at all.
    """
    projections, training = evidence.projections, evidence.training
    order = training[np.argsort(projections.angles_rad[training], kind="stable")]
    chosen = order[:: max(1, -(-len(order) // _MOST_VIEWS))]
    if len(chosen) < _FEWEST_VIEWS:
        return _unknown(Told("{count} projections are too few to tell their noise.", count=len(chosen)))
    height, width = projections.images.shape[1:]
    if min(height, width) <= 2 * _BORDER_PX:
        small = "The projections are {width} x {height} pixels, too small to tell their noise."
        return _unknown(Told(small, width=width, height=height))
    images, peak = _middle(projections.images, chosen), projections.peak(training)
    smooth = gaussian_filter(images, (0, _SORTED_BY_PX, _SORTED_BY_PX))
    shadow = smooth > _SHADOW * np.percentile(smooth, _NEARLY_ALL)
    thin, thick = np.percentile(smooth[shadow], (_THIN, _THICK)) if shadow.any() else (0.0, 0.0)
    if thick <= 0:
        return _unknown(Told("The projections are empty."))
    unknown = of_another_unit(float(np.percentile(smooth, _HIGHEST)))
    if unknown is not None:
        return _unknown(unknown)
    nothing = (_NOTHING * peak) ** 2
    levels = _levels(images, smooth).that_vary(nothing)
    if len(levels.depth) < _FEWEST_BINS:
        return _unknown(
            Told("The projections have too few pixels to tell how noise grows with what the object absorbs.")
        )
    law = _law(levels, nothing)
    # Behind metal the law would have more noise than the few that get through can make.
    most = float(levels.variance.max())
    return _finding(law, _Seen(float(thin), float(thick), law.percent(smooth, peak, most)), peak, most)


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The same projections, which tell a fit how well they are known."""
    tick()
    return replace(projections, noise=CountingNoise(**{name: float(value) for name, value in numbers.items()}))


class _Levels(NamedTuple):
    """Bins of line integrals: their mean (B,), the variance of the noise in them, and how many pixels it is of."""

    depth: np.ndarray
    variance: np.ndarray
    pixels: np.ndarray

    def that_vary(self, nothing: float) -> _Levels:
        """Without bins that have no noise where thinner ones have: behind metal all pixels may read the same value."""
        cut_off = (self.variance < nothing) & (np.maximum.accumulate(self.variance) > _CLEARLY * nothing)
        return _Levels(*(part[~cut_off] for part in self))


class _Law(NamedTuple):
    """The variance of line integrals p: `counting`, 1/N₀, times eᵖ, plus `floor`."""

    counting: float
    floor: float

    def percent(self, depth: np.ndarray | float, peak: float, most: float = np.inf) -> float:
        """Deviation of line integrals of these sizes, rms, in percent of the peak.

        Args:
            most: a variance that none exceeds.
        """
        variance = np.minimum(self.counting * np.exp(depth) + self.floor, most)
        return 100 * float(np.sqrt(np.mean(variance))) / peak


def _middle(images: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(M, rows, width) of the chosen views about the middle row, as many as can be looked at in a second."""
    height, width = images.shape[1:]
    rows = min(height, max(_FEWEST_ROWS, _MOST_PIXELS // (len(chosen) * width)))
    first = (height - rows) // 2
    some = images[chosen, first : first + rows]
    return np.where(np.isfinite(some), some, np.float32(0))


def _levels(images: np.ndarray, smooth: np.ndarray) -> _Levels:
    """The noise of even bins of line integrals (M, height, width), where they rise least."""
    noise = _without_gains(convolve1d(convolve1d(images, _MASK, axis=1), _MASK, axis=2) / _MASK_NORM)
    rise = np.hypot(sobel(smooth, axis=1), sobel(smooth, axis=2))
    inside = (slice(None), slice(_BORDER_PX, -_BORDER_PX), slice(_BORDER_PX, -_BORDER_PX))
    depth, noise, rise = (part[inside].ravel() for part in (smooth, noise, rise))
    edges = np.linspace(0.0, float(np.percentile(depth, _HIGHEST)), _BINS + 1)
    place, found = np.digitize(depth, edges), []
    for index in range(1, _BINS + 1):
        of_bin = np.flatnonzero(place == index)
        few = int(_LEVEL_SHARE * len(of_bin))
        if few < _FEWEST_IN_BIN:
            continue
        level = of_bin[np.argpartition(rise[of_bin], few)[:few]]
        deviation = _TO_DEVIATION * float(np.median(np.abs(noise[level])))
        found.append((float(depth[level].mean()), deviation**2, float(few)))
    return _Levels(*np.array(found, np.float64).reshape(-1, 3).T)


def _without_gains(noise: np.ndarray) -> np.ndarray:
    """Of 2 to 24 views (M, height, width): without what pixels have in all of them, which is their gain's.

    The median of the other views is taken away, because edges pass there, too, and would stay in a mean. It has no part
    in the view's own noise, so that variances add, and white noise comes out as large as it went in.
    """
    count, half = len(noise), len(noise) // 2
    if count % 2:
        low, middle, high = np.partition(noise, (half - 1, half, half + 1), axis=0)[half - 1 : half + 2]
        # What is left of the three in the middle once the view is out.
        twice = np.where(noise < middle, middle + high, np.where(noise > middle, low + middle, low + high))
        others = 0.5 * twice
    else:
        low, high = np.partition(noise, (half - 1, half), axis=0)[half - 1 : half + 1]
        others = np.where(noise <= low, high, low)
    return (noise - others) / np.sqrt(1 + _OF_MEDIANS[count - 2], dtype=noise.dtype)


def _law(levels: _Levels, least: float) -> _Law:
    """Least squares of what is left, relative to what there is: a variance is known to a share of itself.

    Edges and grain of the object answer to the mask as noise does and only ever add to it. So bins with more than the
    law has, beyond what chance makes of so many pixels, are believed less and less (Cauchy's weights), bins with less
    are not.

    Args:
        least: a variance that is none; synthetic air has not even that.
    """
    columns = np.stack([np.exp(levels.depth), np.ones_like(levels.depth)], axis=1)
    expected, weights = np.maximum(levels.variance, least), levels.pixels
    for _ in range(_ROUNDS):
        scale = np.sqrt(weights) / expected
        law = nnls(scale[:, None] * columns, scale * levels.variance)[0]
        before, expected = expected, np.maximum(columns @ law, least)
        if np.allclose(expected, before, rtol=1e-4, atol=0):
            break
        errors = (levels.variance / expected - 1) * np.sqrt(levels.pixels) / _OF_SQUARE
        weights = levels.pixels / (1 + (np.maximum(errors, 0) / _CAUCHY) ** 2)
    counting, floor = law
    return _Law(float(counting), float(floor))


class _Seen(NamedTuple):
    """Line integrals of thin and of thick parts, and the deviation of all pixels' noise in percent of the peak."""

    thin: float
    thick: float
    overall: float


def _finding(law: _Law, seen: _Seen, peak: float, most: float) -> EffectFinding:
    percent = law.percent(seen.thick, peak)
    known = max(_LIMITS, _KNOWN_SHARE * law.percent(seen.thin, peak)) * peak / 100
    numbers = {"per_photon": law.counting, "floor": law.floor, "most": most, "known": known}
    found = percent >= _THRESHOLD
    if percent < _LIMITS:
        little = "Noise is {percent:.2g} % of the peak behind thick parts; from {least:g} % it limits figures."
        reason = Told(little, percent=percent, least=_LIMITS)
        return EffectFinding(_NAME, False, percent, _UNIT, _THRESHOLD, reason, None, numbers if percent > 0 else {})
    most_db = -20 * np.log10(seen.overall / 100)
    done = Told(
        "The fit weighs pixels by how well they are known."
        if found
        else "From {least:g} % on a fit weighs pixels by how well they are known.",
        least=_THRESHOLD,
    )
    if law.counting * np.exp(seen.thick) > law.floor:
        reason = Told(
            "Noise is {percent:.2g} % of the peak behind thick parts, as of {photons:,.0f} photons a pixel of air; "
            "held-out projections stay under about {most:.0f} dB, whatever the model. From {enough:,.0f} on it would "
            "hardly matter. {done}",
            percent=percent,
            photons=_two_digits(1 / law.counting),
            most=most_db,
            enough=_two_digits((percent / _LIMITS) ** 2 / law.counting),
            done=done,
        )
    else:
        reason = Told(
            "Noise is {percent:.2g} % of the peak behind thick parts; held-out projections stay under about "
            "{most:.0f} dB, whatever the model. {done}",
            percent=percent,
            most=most_db,
            done=done,
        )
    return EffectFinding(_NAME, found, percent, _UNIT, _THRESHOLD, reason, None, numbers)


def _two_digits(count: float) -> float:
    return float(f"{count:.2g}")


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
