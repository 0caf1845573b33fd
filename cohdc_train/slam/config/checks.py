"""Range checks of options."""

from cohdc_train.errors import DataError


class Check:
    """Range check of the numbers in one section; a tuple is checked number by number.

    Every method raises DataError that names the option, its value, and the allowed range.
    """

    def __init__(self, section: str, config: object) -> None:
        """Name the section, for the messages, and the config that holds its options."""
        self._section = section
        self._config = config

    def at_least(self, low: float, *names: str) -> None:
        """Raise DataError unless every named option is `low` or more, and finite."""
        for name in names:
            for value in self._values(name):
                self._demand(name, value, low <= value < float("inf"), f"{low:g} or more")

    def above(self, low: float, *names: str) -> None:
        """Raise DataError unless every named option is above `low`, and finite."""
        for name in names:
            for value in self._values(name):
                self._demand(name, value, low < value < float("inf"), f"above {low:g}")

    def within(self, low: float, high: float, *names: str) -> None:
        """Raise DataError unless every named option lies in `low`..`high`, both included."""
        for name in names:
            for value in self._values(name):
                self._demand(name, value, low <= value <= high, f"{low:g} to {high:g}")

    def _values(self, name: str) -> tuple[float, ...]:
        """Return the numbers of an option."""
        value = getattr(self._config, name)
        return value if isinstance(value, tuple) else (value,)

    def _demand(self, name: str, value: float, is_allowed: bool, allowed: str) -> None:
        """Raise DataError unless a value is allowed."""
        if not is_allowed:
            raise DataError(f"{self._section}.{name} is {value:g}; allowed: {allowed}")
