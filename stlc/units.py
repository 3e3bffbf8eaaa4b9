"""Physical units: dimensions as exponent vectors, conversion factors to SI as exact fractions.

`degC` is an affine unit with its zero at 273.15 K: differences are in kelvin (`Unit.interval`), and it cannot
be a factor of a product. Angles are dimensionless (`rad` is 1, `deg` is pi/180), and so are `%` and `1`.
`steps` is not a physical unit; the code that reads an interval handles it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from types import MappingProxyType
from typing import ClassVar

Dims = tuple[int, ...]

_BASES = ("m", "kg", "s", "A", "K", "mol", "cd")
_NONE: Dims = (0,) * len(_BASES)
_FACTOR = re.compile(r"(?P<symbol>[A-Za-zµμ°Ω]+|%|1)(?:\^?(?P<power>[+-]?\d+)|(?P<raised>⁻?[¹²³⁴]))?")
_RAISED = str.maketrans("⁻¹²³⁴", "-1234")
_MAX_POWER = 99
_BLANKS = " \t\r\n"
_QUANTITY = re.compile(
    r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)"
    r"([ \t\r\n]*(?P<unit>[^\d\s.].*)|[ \t\r\n]+(?P<per>1(/.*)?))?"  # such as `2 1/s`
)
_CELSIUS = re.compile(r"deg(?:ree)?s?[_. ]*C(?:elsius)?|°[_ ]*C|Cel(?:sius)?|centigrade", re.IGNORECASE)
_DEFINED: Mapping[str, tuple[Fraction | int | str, str]] = {
    **{"g": ("1/1000", "kg"), "rad": (1, "1"), "sr": (1, "1"), "Hz": (1, "1/s"), "N": (1, "kg*m/s^2")},
    **{"Nm": (1, "N*m"), "Pa": (1, "N/m^2"), "J": (1, "N*m"), "W": (1, "J/s"), "VA": (1, "J/s")},
    **{
        "C": (1, "A*s"),
        "V": (1, "W/A"),
        "F": (1, "C/V"),
        "ohm": (1, "V/A"),
        "Ω": (1, "V/A"),
        "S": (1, "A/V"),
    },
    **{"Wb": (1, "V*s"), "T": (1, "Wb/m^2"), "H": (1, "Wb/A"), "lm": (1, "cd"), "lx": (1, "lm/m^2")},
    **{"Bq": (1, "1/s"), "Gy": (1, "J/kg"), "Sv": (1, "J/kg"), "kat": (1, "mol/s"), "l": ("1/1000", "m^3")},
    **{"L": (1, "l"), "bar": (100_000, "Pa"), "Wh": (3600, "J"), "Ah": (3600, "C")},
    **{"eV": (Fraction("1.602176634e-19"), "J")},
}
"""Unit that takes prefixes -> (size, unit of the size)."""

_PLAIN: Mapping[str, tuple[Fraction | int | str, str]] = {
    **{"min": (60, "s"), "h": (3600, "s"), "ft": ("381/1250", "m"), "mph": ("1397/3125", "m/s")},
    **{"lb": ("45359237/100000000", "kg"), "rpm": (Fraction(math.pi) / 30, "1/s"), "%": ("1/100", "1")},
    **{"deg": (Fraction(math.pi) / 180, "1"), "°": (Fraction(math.pi) / 180, "1")},
}
"""Unit without prefixes -> (size, unit of the size)."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A physical unit; two units are equal if they have the same dimensions, size and zero.

    Attributes:
        dims: exponents of m, kg, s, A, K, mol and cd.
        ratio: size of the unit in SI units, exactly (pi to double precision).
        text: text of the unit in the file; "" if none is declared, but "1" for the declared unit `1`.
        offset: value of the unit's zero in SI units, exactly: 273.15 for `degC`, 0 for units without offset.
    """

    ONE: ClassVar[Unit]
    """The dimensionless unit."""
    SYMBOLS: ClassVar[Mapping[str, Unit]]
    """Symbol -> unit, with all prefixes."""
    PREFIXES: ClassVar = MappingProxyType(
        {
            **{
                "q": -30,
                "r": -27,
                "y": -24,
                "z": -21,
                "a": -18,
                "f": -15,
                "p": -12,
                "n": -9,
                "u": -6,
                "m": -3,
            },
            **{"µ": -6, "μ": -6, "c": -2, "d": -1, "da": 1, "h": 2, "k": 3, "M": 6, "G": 9, "T": 12, "P": 15},
            **{"E": 18, "Z": 21, "Y": 24, "R": 27, "Q": 30},
        }
    )
    """SI prefix -> its power of ten; micro is `u`, the micro sign or the Greek letter."""
    PREFIXED: ClassVar = tuple(sorted({*_BASES, *_DEFINED} - {"kg"}))
    """Units that take prefixes. `T` is a unit with a prefix only: alone, it is the planning horizon."""
    CELSIUS: ClassVar = "degrees Celsius are written `degC`, kelvin `K`"

    dims: Dims = _NONE
    ratio: Fraction = Fraction(1)
    text: str = field(default="", compare=False)
    offset: Fraction = Fraction(0)

    @classmethod
    def parse(cls, text: str) -> Unit:
        """Parse a unit: a product or quotient of powers, e.g. `m/s^2`, `kg*m`, `1/s`, `deg`.

        Raises:
            ValueError: the text is not a unit; the message has the reason.
        """
        cleaned = text.strip(_BLANKS)
        if not cleaned:
            raise ValueError("an empty unit")
        factors = _factors(cleaned)
        for symbol, power in factors:
            unit = cls.SYMBOLS.get(symbol)
            if unit is None:
                raise ValueError(f"unknown unit `{symbol}`")
            if unit.offset:
                if factors == [(symbol, 1)]:
                    return replace(unit, text=cleaned)
                raise ValueError(f"`{symbol}` has a zero of its own and stands alone: {_in_kelvin(factors)}")
            if abs(power) > _MAX_POWER:
                raise ValueError(f"the power {power} of `{symbol}` is too large")
        return cls(*_combined(factors, cls.SYMBOLS), cleaned)

    @classmethod
    def written(cls, text: str) -> Unit:
        """Parse a unit as `parse` does; an empty text is the dimensionless unit. Raises ValueError."""
        return cls.parse(text) if text else cls.ONE

    @classmethod
    def celsius_advice(cls, text: str) -> tuple[str, ...]:
        """Advice about a text that means degrees Celsius but is not `degC`; () for any other text."""
        return (cls.CELSIUS,) if _CELSIUS.fullmatch(text.strip()) else ()

    @property
    def scale(self) -> float:
        """Size of the unit in SI units."""
        return float(self.ratio)

    @property
    def dimensionless(self) -> bool:
        """True if all exponents are 0."""
        return self.dims == _NONE

    @property
    def si(self) -> Unit:
        """The SI unit of the same dimensions."""
        plain = self.ratio == 1 and not self.offset
        return self if plain else Unit(self.dims, text=_si_text(self.dims))

    @property
    def interval(self) -> Unit:
        """The unit of differences: kelvin for `degC`, the unit itself for others."""
        if not self.offset:
            return self
        return Unit(self.dims, self.ratio, _si_text(self.dims) if self.ratio == 1 else f"Δ{self.text}")

    def same_dims(self, other: Unit) -> bool:
        """True if the units have the same dimensions, so that their quantities can be added and compared."""
        return self.dims == other.dims

    def of_si(self, value: float) -> float:
        """Convert a number from SI units to this unit."""
        return (value - float(self.offset)) / self.scale

    def value_of(self, text: str) -> float:
        """Parse a finite number with or without a unit, such as `36 km/h`, and return its value in this unit.

        Raises:
            ValueError: the text is not such a number, or its unit has another dimension; the message has the
                reason.
        """
        match = _QUANTITY.fullmatch(text.strip())
        found = float(match["number"]) if match is not None else math.nan
        if match is None or not math.isfinite(found):
            raise ValueError(f"`{text.strip()}` is not a finite number")
        given = Unit.parse(written) if (written := match["unit"] or match["per"]) else self
        if given.dims != self.dims:
            raise ValueError(f"`{given}` is not a unit of [{self}]")
        return found if given == self else self.of_si(found * given.scale + float(given.offset))

    def __mul__(self, other: Unit) -> Unit:
        return _product(((self, 1), (other, 1)))

    def __truediv__(self, other: Unit) -> Unit:
        return _product(((self, 1), (other, -1)))

    def __pow__(self, power: int | Fraction) -> Unit:
        """The unit to a power. Raises ValueError if an exponent of the result is not a whole number."""
        power = Fraction(power)
        if abs(power) > _MAX_POWER:
            raise ValueError(f"[{self}] to the power {power} is out of bounds")
        if power.denominator == 1:
            return _product(((self, int(power)),))
        if self.offset:
            return self.interval**power
        dims = tuple(exponent * power for exponent in self.dims)
        if any(exponent.denominator != 1 for exponent in dims):
            raise ValueError(f"[{self}] to the power {power} has no unit")
        whole = tuple(int(exponent) for exponent in dims)
        return Unit(whole, Fraction(self.scale ** float(power)), text=_si_text(whole))

    @property
    def shown(self) -> str:
        """The unit as a text; `1` for numbers without a unit."""
        return str(self)

    def __str__(self) -> str:
        return self.text or _si_text(self.dims)


def _symbols() -> Mapping[str, Unit]:
    table = {"1": Unit(text="1")}
    for index, text in enumerate(_BASES):
        table[text] = Unit(tuple(int(index == other) for other in range(len(_BASES))), text=text)
    for text, (size, of) in {**_DEFINED, **_PLAIN}.items():
        dims, ratio = _combined(_factors(of), table)
        table[text] = Unit(dims, Fraction(size) * ratio, text)
    for text in Unit.PREFIXED:
        for prefix, power in Unit.PREFIXES.items():
            whole = prefix + text
            table.setdefault(whole, Unit(table[text].dims, table[text].ratio * Fraction(10) ** power, whole))
    del table["T"]
    table["degC"] = Unit(table["K"].dims, Fraction(1), "degC", Fraction("273.15"))
    table["°C"] = replace(table["degC"], text="°C")
    return MappingProxyType(table)


def _combined(factors: Iterable[tuple[str, int]], symbols: Mapping[str, Unit]) -> tuple[Dims, Fraction]:
    """Return dimensions and size of a product of powers of known units, given as pairs (symbol, power)."""
    dims, ratio = _NONE, Fraction(1)
    for symbol, power in factors:
        unit = symbols[symbol]
        dims = tuple(a + b * power for a, b in zip(dims, unit.dims, strict=True))
        ratio *= unit.ratio**power
    return dims, ratio


def nearest(value: Fraction | float) -> float:
    """Return the double nearest to a number; inf or -inf for a number beyond the largest double."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def time_text(seconds: Fraction | float) -> str:
    """Text of a length of time: in hours or minutes if it is at least two and whole (hours in quarters)."""
    for unit, size, part in (("h", 3600, 900), ("min", 60, 60)):
        if seconds >= 2 * size and seconds % part == 0:
            return f"{nearest(seconds) / size:g} {unit}"
    return f"{nearest(seconds):g} s"


def _factors(text: str) -> list[tuple[str, int]]:
    """Split the text of a unit into pairs (symbol, power); each `/` divides by the next factor only.

    Raises:
        ValueError: the text is not a unit.
    """
    factors: list[tuple[str, int]] = []
    position, sign = 0, 1
    while True:
        match = _FACTOR.match(text, position)
        if match is None:
            raise ValueError(f"`{text}` is not a unit")
        raised = (match["raised"] or "").translate(_RAISED)
        factors.append((match["symbol"], sign * int(match["power"] or raised or 1)))
        rest = text[match.end() :].lstrip(_BLANKS)
        if not rest:
            return factors
        sign = -1 if rest[0] == "/" else 1
        tail = rest[1:] if rest[0] in "/*·." else rest
        position = len(text) - len(tail.lstrip(_BLANKS))


def _in_kelvin(factors: Iterable[tuple[str, int]]) -> str:
    """Advice for a unit that is a product with `degC`, such as `W/degC`: the same product with `K`."""
    powers: dict[str, int] = {}
    for symbol, power in factors:
        known = Unit.SYMBOLS.get(symbol)
        name = str(known.interval) if known is not None and known.offset else symbol
        powers[name] = powers.get(name, 0) + power
    return f"write `{_text(powers)}`"


def _product(parts: Iterable[tuple[Unit, int]]) -> Unit:
    """Product of powers of units, given as pairs (unit, power).

    The text of the product keeps the symbols of the given units: the square of `km` is `km^2`.
    """
    dims, ratio = _NONE, Fraction(1)
    powers: dict[str, int] = {}
    parts = [(unit.interval, power) for unit, power in parts]
    for unit, power in parts:
        dims = tuple(a + b * power for a, b in zip(dims, unit.dims, strict=True))
        ratio *= unit.ratio**power
        for symbol, exponent in _factors(unit.text) if unit.text else ():
            powers[symbol] = powers.get(symbol, 0) + exponent * power
    return Unit(dims, ratio, _text(powers) if any(unit.text for unit, _ in parts) else "")


def _si_text(dims: Dims) -> str:
    return _text(dict(zip(_BASES, dims, strict=True)))


def _text(powers: Mapping[str, int]) -> str:
    """Text of a unit, such as `kg*m/s^2`, `1/s`, `1`, from its mapping symbol -> power."""

    def written(symbol: str, power: int) -> str:
        return symbol if power == 1 else f"{symbol}^{power}"

    above = [written(s, p) for s, p in powers.items() if p > 0 and s != "1"]
    below = [written(s, -p) for s, p in powers.items() if p < 0 and s != "1"]
    return "/".join(["*".join(above) or "1", *below])


Unit.ONE = Unit()
Unit.SYMBOLS = _symbols()
