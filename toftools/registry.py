"""Names to methods: the one thin table behind the command line, the benchmark and the law tests.

An entry is a string ``module:function`` that is imported when it is built, so a missing optional
package fails only for its own method, and a user's ``mypkg.mine:make`` needs no entry at all.
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from toftools._params import checked_params as checked_params
from toftools._params import parse_entry as parse_entry
from toftools._params import parse_name as parse_name


@dataclass(frozen=True)
class Spec:
    """Where a method lives and which parameters the benchmark sweeps.

    Parameters
    ----------
    target : str
        ``module:function`` of a Factory.
    grid : mapping of str to tuple
        Values to sweep per parameter; empty for a method without a dial.
    params : mapping
        Parameters fixed by the caller (``name:key=val``).
    name : str
        Registry name, or the target itself for a user's method.
    unit : str
        Unit of a metric; empty for a plain number.
    better : str
        Of a metric: ``lower``, ``higher`` or ``zero``.
    place : str
        Of a filter: ``before`` or ``after`` the correction.
    """

    target: str
    grid: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    unit: str = ""
    better: str = ""
    place: str = ""

    def load(self) -> Callable[..., Any]:
        """Import the factory.

        Returns
        -------
        callable
            ``make(context, *, params)``.

        Raises
        ------
        ValueError
            If the module or the function does not exist.
        """
        module, _, function = self.target.partition(":")
        try:
            make = getattr(importlib.import_module(module), function)
        except Exception as error:  # importing a user's file may raise anything
            detail = f"{type(error).__name__}: {error}"
            msg = f"cannot load method {self.target!r}: {' '.join(detail.split())}"
            raise ValueError(msg) from error
        if not callable(make):
            msg = f"cannot load method {self.target!r}: got {make!r}, wanted a function"
            raise ValueError(msg)
        return make  # type: ignore[no-any-return]

    def build(self, context: object, **params: object) -> Callable[[Any], Any]:
        """Make the method for a context.

        Parameters
        ----------
        context : object
            Sensor, Scene, captures or truth, by kind.
        **params
            Parameters on top of those in the spec.

        Returns
        -------
        callable
            ``run(input) -> output``.

        Raises
        ------
        ValueError
            If a parameter is unknown to the method or of another kind than its default.
        """
        make, name = self.load(), self.name or self.target
        checked = checked_params(name, parameters_of(make), {**self.params, **params})
        return make(context, **checked)  # type: ignore[no-any-return]


def parameters_of(make: Callable[..., Any]) -> dict[str, Any]:
    """Keyword parameters of a factory with their defaults.

    Parameters
    ----------
    make : callable
        ``make(context, *, params)``.

    Returns
    -------
    dict
        Name to default value.
    """
    return {
        name: parameter.default
        for name, parameter in inspect.signature(make).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    }


def find(table: Mapping[str, Spec], text: str) -> Spec:
    """The spec behind ``name[:key=val,...]`` or a user's ``module.path:function[:key=val,...]``.

    Parameters
    ----------
    table : mapping
        One of the registries of this module.
    text : str
        Name as typed.

    Returns
    -------
    Spec
        The entry, with the typed parameters fixed.

    Raises
    ------
    ValueError
        If the name is neither known nor of the form ``module.path:function``.
    """
    registered = text.strip().partition(":")[0] in table
    name, params = parse_entry(text) if registered else parse_name(text)
    if registered:
        entry = table[name]
        return replace(entry, params={**entry.params, **params})
    if ":" in name:
        return Spec(name, {}, params, name)
    msg = f"unknown name {name!r}; known: {', '.join(table)}; or give mypkg.mine:make"
    raise ValueError(msg)


def _table(**specs: Spec) -> Mapping[str, Spec]:
    return MappingProxyType({name: replace(spec, name=name) for name, spec in specs.items()})


def _percentile(q: float) -> Spec:
    return Spec("toftools.metrics.error:percentile_m", params={"q": q}, unit="m", better="lower")


def _under(limit_m: float) -> Spec:
    params = {"limit_m": limit_m}
    return Spec("toftools.metrics.error:share_under", params=params, better="higher")


def _statistics(distribution: str) -> dict[str, Spec]:
    """The three comparisons of thesis 7.B for one distribution."""
    compare = {"chi2": "lower", "js": "lower", "pearson": "higher"}
    return {
        f"{distribution}_{name}": Spec(
            f"toftools.metrics.statistics:{name}",
            params={"distribution": distribution},
            better=better,
        )
        for name, better in compare.items()
    }


SIMULATORS = _table(
    analytic=Spec("toftools.sim.analytic:analytic"),
    radiosity=Spec("toftools.sim.radiosity:radiosity", grid={"antialias": (1, 4)}),
    path=Spec("toftools.sim.path:path", grid={"antialias": (1, 4)}),
)
CALIBRATIONS = _table(
    lens=Spec("toftools.calib.lens:lens", grid={"distortion": (0, 4, 5, 8)}),
    lens_fisheye=Spec("toftools.calib.lens:lens_fisheye"),
    response=Spec("toftools.calib.response:response"),
    wiggling=Spec("toftools.calib.wiggling:wiggling", grid={"harmonics": (4, 8, 0)}),
    wiggling_spline=Spec(
        "toftools.calib.wiggling_spline:wiggling_spline", grid={"knots": (8, 16, 32, 0)}
    ),
    wiggling_lut=Spec("toftools.calib.wiggling_lut:wiggling_lut", grid={"knots": (16, 32, 0)}),
    common_phase=Spec("toftools.calib.common_phase:common_phase"),
    fixed_pattern=Spec("toftools.calib.fixed_pattern:fixed_pattern"),
    amplitude=Spec("toftools.calib.amplitude:amplitude"),
    temperature=Spec("toftools.calib.temperature:temperature"),
    extrinsics=Spec("toftools.calib.extrinsics:extrinsics"),
)
CORRECTIONS = _table(
    single=Spec("toftools.correct.single:single"),
    crt=Spec("toftools.correct.crt:crt", grid={"max_range_m": (5.0, 10.0, 0.0)}),
    residual_voting=Spec(
        "toftools.correct.residual_voting:residual_voting", grid={"lax_rad": (0.35, 0.61, 1.2)}
    ),
    kde=Spec("toftools.correct.kde:kde", grid={"window_px": (3, 7, 11), "hypotheses": (2, 4)}),
    sra=Spec(
        "toftools.correct.sra:sra", grid={"max_range_m": (4.0, 0.0), "first_share": (0.01, 0.05)}
    ),
    sra_lp=Spec("toftools.correct.sra_lp:sra_lp"),
    auto=Spec("toftools.correct.auto:auto"),
    fuchs2010=Spec(
        "toftools.correct.fuchs2010:fuchs2010",
        grid={"tol_mm": (0.3, 1.0, 3.0, 10.0), "iterations": (1, 3)},
    ),
    fuchs2010_all_pairs=Spec("toftools.correct.fuchs2010_all_pairs:fuchs2010_all_pairs"),
    fuchs2013=Spec(
        "toftools.correct.fuchs2013:fuchs2013",
        grid={"segments": (1, 2, 4, 8), "tol_mm": (1.0, 10.0)},
    ),
    jimenez2014=Spec(
        "toftools.correct.jimenez2014:jimenez2014",
        grid={"nodes": (100, 400, 1200), "iterations": (3, 10)},
    ),
    gupta2015=Spec("toftools.correct.gupta2015:gupta2015"),
    heide2013=Spec(
        "toftools.correct.heide2013:heide2013",
        grid={"iterations": (15, 60, 240), "weight": (3e-4, 1e-3, 1e-2)},
    ),
    dorrington2011=Spec(
        "toftools.correct.dorrington2011:dorrington2011",
        grid={"starts": (1, 2, 4, 8), "max_extra_m": (1.5, 2.5)},
    ),
    godbaz2012_ratio=Spec(
        "toftools.correct.godbaz2012_ratio:godbaz2012_ratio",
        grid={"first_share": (0.02, 0.05, 0.1), "false_alarm": (1e-5, 1e-3, 0.1)},
    ),
    godbaz2012_cauchy=Spec(
        "toftools.correct.godbaz2012_cauchy:godbaz2012_cauchy",
        grid={"first_share": (0.02, 0.05, 0.1), "false_alarm": (1e-5, 1e-3, 0.1)},
    ),
    kirmani2013=Spec(
        "toftools.correct.kirmani2013:kirmani2013", grid={"refine": (0, 2, 20), "returns": (1, 2)}
    ),
    bhandari2014=Spec(
        "toftools.correct.bhandari2014:bhandari2014",
        grid={"refine": (0, 2, 20), "returns": (1, 2, 3)},
    ),
    bhandari2014_annihilating=Spec(
        "toftools.correct.bhandari2014_annihilating:bhandari2014_annihilating",
        grid={"refine": (0, 2, 20), "returns": (1, 2)},
    ),
    feigin2016=Spec(
        "toftools.correct.feigin2016:feigin2016",
        grid={"returns": (1, 2), "first_share": (0.02, 0.05, 0.1)},
    ),
    peters2015=Spec("toftools.correct.peters2015:peters2015", grid={"bias": (0.3, 1.0, 3.0)}),
    peters2015_pisarenko=Spec(
        "toftools.correct.peters2015_pisarenko:peters2015_pisarenko",
        grid={"refine": (0, 2, 20), "returns": (2, 4)},
    ),
    semi_global=Spec("toftools.correct.semi_global:semi_global", grid={"jump": (0.0, 4.0, 16.0)}),
    network=Spec("toftools.correct.network:network"),
    two_returns=Spec("toftools.correct.two_returns:two_returns", grid={"max_range_m": (0.0, 10.0)}),
)
FILTERS = _table(
    smooth=Spec("toftools.filter.smooth:smooth", grid={"radius_px": (1, 2, 3)}, place="before"),
    flying_pixels=Spec(
        "toftools.filter.flying_pixels:flying_pixels",
        grid={"least_neighbours": (2, 3, 4)},
        place="after",
    ),
)
"""Steps around a correction: ``run(Phasors) -> Phasors`` before it, ``run(DepthMap, Phasors) ->
DepthMap`` after it; `toftools.chain` joins them."""
METRICS = _table(
    bias_m=Spec("toftools.metrics.error:bias_m", unit="m", better="zero"),
    mae_m=Spec("toftools.metrics.error:mae_m", unit="m", better="lower"),
    rmse_m=Spec("toftools.metrics.error:rmse_m", unit="m", better="lower"),
    median_m=_percentile(50),
    **{f"p{q}_m": _percentile(q) for q in (25, 75, 95, 99)},
    under_1cm=_under(0.01),
    under_2cm=_under(0.02),
    under_5cm=_under(0.05),
    r2=Spec("toftools.metrics.error:r2", better="higher"),
    valid_share=Spec("toftools.metrics.error:valid_share", better="higher"),
    wrap_share=Spec("toftools.metrics.error:wrap_share", better="lower"),
    coherence=Spec("toftools.metrics.coherence:coherence", better="higher"),
    **_statistics("range"),
    **_statistics("gradient_h"),
    **_statistics("gradient_v"),
    **_statistics("cooccurrence"),
    **_statistics("haar_hv"),
    **_statistics("haar_hd"),
)
_FORMATS = ("su2018", "melexis_npy", "azure_mkv", "adi_bin", "ifm_o3r", "espros_h5",
            "depth_png", "npz", "transient")  # fmt: skip
READERS = _table(**{name: Spec(f"toftools.io.readers.{name}:read") for name in _FORMATS})
"""Foreign formats; ``read(path, *, convention...)`` gives a Capture, ``sniff`` recognises one."""
_MAKERS = ("kinect2", "ti", "adi")
FACTORY = _table(**{name: Spec(f"toftools.calib.factory.{name}:load") for name in _MAKERS})
"""Tables that makers of cameras ship; ``load(path, *, convention...)`` gives a Chain."""
