"""Response of the pixels: dark level, curve, gain, saturation, bad pixels, conversion gain.

Model: a tap reads ``L(x) = g_p q + d_p``, where q is the charge that light leaves in a faultless
pixel, g_p the gain of node p (photo-response non-uniformity, imbalance of nodes A and B), d_p its
dark level, and L the curve that makes raw numbers x linear in charge. The curve comes first since
it acts on all charge, that of the dark included. Fitted from captures of kind dark and of kind flat
at several exposures; modulated light may light the flats where the taps of a node determine its
offset (`toftools.calib._response_data`). Conversion gain and read noise follow from photon transfer
(EMVA Standard 1288, Release 4.0 Linear) where exposures are repeated or the light is not modulated.

Phase does not need this stage where all taps share one node: a common gain, and a dark level that
is the same in all taps, drop out of their differences. It matters for two-tap pixels that are not
read in both orders, for curved read-outs, and for all that is read off taps: amplitude, saturation,
noise.

Fails where the surface is not evenly lit: its shading is then in the gain (a note says how much);
where exposures are not known to the accuracy that is asked of the curve; and beyond the brightest
flat, where the curve goes on straight. Differential taps (A minus B in one number) have no level to
fit; their table, if there is one, comes from the factory (`toftools.calib.factory`).

Measured (tests/test_response.py: 48 x 36 px, two nodes, 20,000 electrons, eight exposures twice,
four dark frames): gain of a pixel to 0.14 % of 3 % planted, dark level to 6.6 of 40 electrons, both
as their deviations say; a read-out bent by 4.7 % straightened to 0.03 %; dn_per_e to 0.4 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from toftools._arrays import expect_shape, frozen, kernel_input, set_fields
from toftools.calib._response_data import declared_saturation, levels_of
from toftools.calib._response_fit import KNOTS, curve_values, fit_curve, fit_gain
from toftools.calib._response_kernel import linearise
from toftools.calib._response_noise import transfer
from toftools.calib._response_report import bad_pixels, noted, residual_of, rough_good
from toftools.calib.stage import Residual
from toftools.conditions import conditions_of
from toftools.types import F32, F64, Capture, Phasors, Taps

GOOD, HOT, DEAD, NOISY = 0, 1, 2, 4
"""Bits of `Response.bad`: dark level out of family, gain out of family or none, too much noise."""
NAN = float("nan")


@dataclass(frozen=True, eq=False)
class Response:
    """What pixels make of charge, taken back.

    Parameters
    ----------
    offset, offset_sd : ndarray, (N, H, W)
        Dark level of a tap of each node after the curve, and its standard deviation; unit of taps.
    gain, gain_sd : ndarray, (N, H, W)
        Response relative to the mean of node A, and its standard deviation; positive.
    bad : ndarray, (H, W), int
        0, or the sum of 1 hot, 2 dead, 4 noisy.
    curve : ndarray, (M,)
        Linear value of the raw levels 0, `step`, 2 `step` ...
    step : float
        Distance of the knots of the curve, raw units.
    terms, terms_sd : ndarray, (J,)
        Coefficients of the fitted curve, as of `toftools.calib._response_fit`; a lone 0 if it is
        straight, or is a table.
    saturation : float
        Raw level from which on a tap is saturated; infinite if none was seen.
    lowest : float
        Raw level below which a tap is none.
    lost : float
        Raw code that stands for a saturated tap; NaN if there is none.
    dn_per_e, dn_per_e_sd : float
        Conversion gain, unit of linear taps per electron; NaN if unknown.
    read_e, read_e_sd : float
        Noise of a dark tap, shot noise of its dark charge included, electrons; NaN if unknown.
    residual : Residual
        Relative error of the levels of flats, %.
    """

    slot: ClassVar[str] = "response"

    offset: F32
    gain: F32
    bad: np.ndarray
    curve: F64
    step: float
    offset_sd: F32
    gain_sd: F32
    terms: F64
    terms_sd: F64
    saturation: float = float("inf")
    lowest: float = float("-inf")
    lost: float = NAN
    dn_per_e: float = NAN
    dn_per_e_sd: float = NAN
    read_e: float = NAN
    read_e_sd: float = NAN
    residual: Residual = field(default_factory=lambda: Residual("%"))

    def __post_init__(self) -> None:
        offset, gain = (frozen(getattr(self, n), np.float32, n, 3) for n in ("offset", "gain"))
        bad = frozen(self.bad, np.int64, "bad", 2)
        curve = frozen(self.curve, np.float64, "curve", 1)
        expect_shape("gain", gain, offset.shape)
        expect_shape("bad", bad, offset.shape[1:])
        set_fields(self, offset=offset, gain=gain, bad=bad, curve=curve)
        for name in ("offset_sd", "gain_sd"):
            value = frozen(getattr(self, name), np.float32, name, 3)
            expect_shape(name, value, offset.shape)
            set_fields(self, **{name: value})
        for name in ("terms", "terms_sd"):
            set_fields(self, **{name: frozen(getattr(self, name), np.float64, name, 1)})
        finite = all(np.isfinite(a).all() for a in (offset, gain, curve, self.terms))
        if not (finite and (gain > 0).all() and offset.shape[0] in (1, 2) and curve.size >= 2):
            msg = "offset, gain and curve must be finite, gain positive, of 1 or 2 nodes, 2 knots"
            raise ValueError(msg)
        if not (0 < self.step < np.inf and self.lowest < self.saturation):
            msg = (
                "step must be positive and lowest below saturation, "
                f"got {self.step}, {self.lowest} and {self.saturation}"
            )
            raise ValueError(msg)

    def on_taps(self, taps: Taps) -> Taps:
        """Linear taps: curve, dark level off, gain divided out.

        Parameters
        ----------
        taps : Taps
            Raw taps (F, K, H, W); tap k is of node k modulo N.

        Returns
        -------
        Taps
            Same unit. Invalid are pixels that are bad or have a tap outside the readable levels.
            The dark charge is off, so noise that is read off these taps lacks its shot noise.

        Raises
        ------
        ValueError
            If the image size differs, or the taps do not come in whole exposures of N nodes.
        """
        _, n_taps, *shape = taps.values.shape
        if tuple(shape) != self.bad.shape or n_taps % self.offset.shape[0]:
            msg = (
                f"the response is of {self.offset.shape[0]} nodes and {self.bad.shape} pixels, "
                f"got taps {taps.values.shape}"
            )
            raise ValueError(msg)
        slope = np.diff(self.curve) / self.step
        values, good = linearise(
            kernel_input(taps.values.reshape(-1, *shape)),
            kernel_input(self.offset),
            kernel_input(1 / self.gain),
            kernel_input(
                (self.curve[:-1] - slope * self.step * np.arange(slope.size)).astype(np.float32)
            ),
            kernel_input(slope.astype(np.float32)),
            float(self.step),
            (float(self.lowest), float(self.saturation), float(self.lost)),
            kernel_input(taps.valid & (self.bad == GOOD)),
        )
        return Taps(values.reshape(taps.values.shape), taps.unit, good)

    def __call__(self, phasors: Phasors) -> Phasors:
        """Phasors with bad pixels invalid.

        Nothing else is done: phasors are differences of taps, from which a dark level drops out,
        and the phase of differences of taps of equal gain does not depend on that gain.

        Parameters
        ----------
        phasors : Phasors
            (F, H, W).

        Returns
        -------
        Phasors
            The same values.

        Raises
        ------
        ValueError
            If the image size differs.
        """
        expect_shape("phasors", phasors.values[0], self.bad.shape)
        return Phasors(phasors.values, phasors.sigma, phasors.valid & (self.bad == GOOD))


def response(
    captures: Sequence[Capture], *, saturation: float = 0.0, z_bad: float = 6.0
) -> Response:
    """Fit the response from dark and flat captures.

    Parameters
    ----------
    captures : sequence of Capture
        At least one of kind dark and one of kind flat, with taps; four exposures or more for a
        curve, two captures of an exposure for the conversion gain. Others are passed over.
    saturation : float
        Raw level from which on taps are saturated; 0 takes what sensor and captures say.
    z_bad : float
        Robust standard deviations from which on a pixel is bad.

    Returns
    -------
    Response
        The stage.

    Raises
    ------
    ValueError
        If a kind is missing, or a capture is black, saturated, without taps or of another camera;
        the sentence names it.

    References
    ----------
    EMVA Standard 1288, Release 4.0 Linear: photon transfer, linearity, non-uniformity.
    """
    if saturation < 0 or not z_bad > 0:
        msg = f"saturation must not be negative and z_bad positive, got {saturation} and {z_bad}"
        raise ValueError(msg)
    used = [c for c in captures if conditions_of(c).kind in ("dark", "flat")]
    limit = saturation or declared_saturation(used)
    dark, lit, top = levels_of(used, limit)
    curve = fit_curve(dark, lit, rough_good(dark, lit))
    offset, light, light_sd, pull = fit_gain(dark, lit, curve.terms)
    found = transfer(dark, lit, curve.terms, top, top * offset, rough_good(dark, lit), z_bad)
    offset_sd = np.sqrt(
        (found.variance + found.rounding) * offset.shape[0] / (len(dark) * dark[0].n_taps)
    )
    bad, shading = bad_pixels(offset, light, found.noisy, float(offset_sd) / top, z_bad)
    notes = noted(bad, shading, curve, lit, found)
    light_sd = np.hypot(light_sd, pull * offset_sd / top)
    usable = np.isfinite(light) & (light > 0)
    usual = float(np.mean(light[0][bad == GOOD]))
    straight = curve.terms.size == 0
    at = np.linspace(0, 1, 2 if straight else KNOTS)
    return Response(
        offset=np.asarray(top * offset, dtype=np.float32),
        gain=np.where(usable, light / usual, 1.0).astype(np.float32),
        bad=bad,
        curve=top * curve_values(curve.terms, at),
        step=top * float(at[1]),
        offset_sd=np.full(offset.shape, offset_sd, np.float32),
        gain_sd=np.where(usable, light_sd / usual, np.nan).astype(np.float32),
        terms=np.zeros(1) if straight else curve.terms,
        terms_sd=np.zeros(1) if straight else curve.sd,
        saturation=limit,
        dn_per_e=found.gain,
        dn_per_e_sd=found.gain_sd,
        read_e=found.read_e,
        read_e_sd=found.read_e_sd,
        residual=residual_of((dark, lit), curve, bad == GOOD, found, top, notes),
    )
