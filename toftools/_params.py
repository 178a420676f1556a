"""What a user types, ``name:key=val,...``, into a name and checked parameters."""

from collections.abc import Mapping
from numbers import Real
from typing import Any

LARGEST = 1e18
"""No parameter in SI units is larger."""


def checked_params(
    what: str, defaults: Mapping[str, Any], params: Mapping[str, Any]
) -> dict[str, Any]:
    """Parameters as given, refused where one is unknown or of another kind than its default.

    Parameters
    ----------
    what : str
        Name of the method, scene or sensor, for the message.
    defaults : mapping
        Every parameter with its default, whose type decides; None takes anything.
    params : mapping
        What the user gave.

    Returns
    -------
    dict
        The given parameters; a whole float where an int is wanted becomes one.

    Raises
    ------
    ValueError
        If a name is unknown, or a value is a word for a number, a fraction for a whole number,
        not finite, and so on.

    Examples
    --------
    >>> checked_params("kde", {"window_px": 7}, {"window_px": 5.0})
    {'window_px': 5}
    """
    checked = {}
    for key, value in params.items():
        if key not in defaults:
            msg = f"{what} has no parameter {key!r}; it takes: {', '.join(defaults) or 'none'}"
            raise ValueError(msg)
        default = defaults[key]
        if not _fits(value, default) and value != default:
            msg = f"{what} got {key}={value!r}, wanted {_wanted(default)}"
            raise ValueError(msg)
        whole = type(default) is int and isinstance(value, float)
        checked[key] = int(value) if whole else value
    return checked


def _is_number(value: object) -> bool:
    # The comparison refuses nan and inf as well.
    real = isinstance(value, Real) and not isinstance(value, bool)
    return real and bool(abs(value) < LARGEST)  # type: ignore[arg-type]  # Real has abs


def _fits(value: Any, default: object) -> bool:  # noqa: ANN401 - parsed from text
    """Whether a value is of the kind of a default."""
    match default:
        case bool():
            return isinstance(value, bool)
        case int():
            return _is_number(value) and value == int(value)
        case float():
            return _is_number(value)
        case str():
            return isinstance(value, str)
        case tuple():
            items = value if isinstance(value, tuple | list) else (value,)
            return all(map(_is_number, items))
        case _:
            return True


def _wanted(default: object) -> str:
    """The kind of a default in words."""
    match default:
        case bool():
            return "true or false"
        case int():
            return f"a whole number such as {default}"
        case float():
            return f"a number such as {default:g}"
        case tuple():
            return "numbers joined by +, such as 20e6+50e6"
        case _:
            return f"a word such as {default!r}"


def parse_value(text: str) -> Any:  # noqa: ANN401 - the type is what the text says
    """Value of one ``key=val``: int, float, bool, ``a+b`` tuple, or the string itself.

    Parameters
    ----------
    text : str
        What stands right of the equals sign.

    Returns
    -------
    int, float, bool, tuple or str
        The value.

    Examples
    --------
    >>> parse_value("20e6+50e6"), parse_value("3"), parse_value("true"), parse_value("1e+6")
    ((20000000.0, 50000000.0), 3, True, 1000000.0)
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    if "+" in text:
        return tuple(parse_value(part) for part in text.split("+"))
    return text


def parse_entry(text: str) -> tuple[str, dict[str, Any]]:
    """Split ``name:key=val,...`` into the name and its parameters.

    Parameters
    ----------
    text : str
        A scene, a sensor or a registered name as typed.

    Returns
    -------
    tuple of str and dict
        Name and parameters.

    Raises
    ------
    ValueError
        If a parameter has no equals sign or is given twice.

    Examples
    --------
    >>> parse_entry("wall:range=2,tilt=30")
    ('wall', {'range': 2, 'tilt': 30})
    """
    head, _, tail = text.strip().partition(":")
    return head, _parse_params(tail, text)


def parse_name(text: str) -> tuple[str, dict[str, Any]]:
    """Split a method, ``name:key=val,...`` or ``mypkg.mine:make:key=val,...``, likewise.

    Parameters
    ----------
    text : str
        A method as typed.

    Returns
    -------
    tuple of str and dict
        Name, which may itself hold one colon, and parameters.

    Raises
    ------
    ValueError
        If a parameter has no equals sign or is given twice.

    Examples
    --------
    >>> parse_name("mypkg.mine:make:k=1")
    ('mypkg.mine:make', {'k': 1})
    """
    head, _, tail = text.strip().partition(":")
    function, _, rest = tail.partition(":")
    if function and "=" not in function:  # module:function
        return f"{head}:{function}", _parse_params(rest, text)
    return head, _parse_params(tail, text)


def _parse_params(tail: str, text: str) -> dict[str, Any]:
    params: dict[str, Any] = {}
    for item in filter(None, tail.split(",")):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not key.isidentifier():
            msg = f"got {item!r} in {text!r}; wanted key=value pairs separated by commas"
            raise ValueError(msg)
        if key in params:
            msg = f"got {key} twice in {text!r}; wanted every key once"
            raise ValueError(msg)
        params[key] = parse_value(value)
    return params
