"""What each correction models of the light: one thin table, for the ladders of a report."""

from collections.abc import Mapping
from types import MappingProxyType

from toftools.registry import parse_name

DIRECT = "direct light"
NEIGHBOURS = "direct light, neighbours alike"
TWO = "two returns"
MANY = "several returns"
BOUNCES = "diffuse bounces of what is seen"
SPREAD = "light spread over time"
LEARNED = "learned"
CHOICE = "chosen per pixel"
UNKNOWN = "not known"

MODELS: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("single", "crt", "gupta2015"), DIRECT)
    | dict.fromkeys(("residual_voting", "kde", "semi_global"), NEIGHBOURS)
    | dict.fromkeys(
        ("two_returns", "dorrington2011", "godbaz2012_ratio", "godbaz2012_cauchy"), TWO
    )
    | dict.fromkeys(
        ("sra", "sra_lp", "kirmani2013", "bhandari2014", "bhandari2014_annihilating",
         "feigin2016", "peters2015_pisarenko"), MANY)
    | dict.fromkeys(("fuchs2010", "fuchs2010_all_pairs", "fuchs2013", "jimenez2014"), BOUNCES)
    | dict.fromkeys(("heide2013", "peters2015"), SPREAD)
    | {"network": LEARNED, "auto": CHOICE}
)  # fmt: skip
"""Correction to its model of light."""


def light_model(method: str) -> str:
    """Model of light of a method.

    Parameters
    ----------
    method : str
        A correction, or a chain with one in it, with or without parameters.

    Returns
    -------
    str
        One of the texts of this module; that of the last correction of a chain.

    Examples
    --------
    >>> light_model("smooth:radius_px=2 > crt > flying_pixels"), light_model("mine:make")
    ('direct light', 'not known')
    """
    found = [MODELS.get(parse_name(part.strip())[0]) for part in method.split(">")]
    return next((model for model in reversed(found) if model), UNKNOWN)
