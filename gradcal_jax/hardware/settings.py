"""Settings of a device that a driver changes: what they were is kept, and put back when the driver goes.

What they were must outlive this process, too: whoever is told (`on_first_change`) can hand it to another one, whose
driver then puts back what it never changed itself.
"""

from collections.abc import Callable, Mapping

from .errors import HardwareError


class KeptSettings:
    """The settings of one device, by the driver's names, as the device spells their values.

    `read` asks the device, `write` returns only when the device shows the new value, and `same` says whether it does.
    A device that a driver changes nothing of has a `KeptSettings()`.
    """

    def __init__(
        self,
        read: Callable[[str], str] | None = None,
        write: Callable[[str, str], None] | None = None,
        same: Callable[[str, str], bool] = str.__eq__,
    ) -> None:
        self._read, self._write, self._same = read, write, same
        self.before: dict[str, str] = {}
        self.on_first_change: Callable[[str, str], None] = lambda name, value: None

    def change(self, name: str, value: str) -> None:
        """Set a setting, unless it has that value already."""
        assert self._write is not None
        if not self._same(self.note(name, value), value):
            self._write(name, value)

    def note(self, name: str, value: str) -> str:
        """Keep what a setting is, which is about to become `value` by some other command. Returns what it is."""
        assert self._read is not None
        shown = self._read(name)
        if name not in self.before and not self._same(shown, value):
            self.before[name] = shown
            self.on_first_change(name, shown)
        return shown

    def keep(self, before: Mapping[str, str]) -> None:
        """What the settings were, as another process heard it."""
        self.before = {**before, **self.before}

    def put_back(self) -> None:
        """Every setting as it was, the last that was changed first. All are tried; raises the first problem."""
        problem: HardwareError | None = None
        for name, value in reversed(list(self.before.items())):
            assert self._read is not None
            assert self._write is not None
            try:
                if not self._same(self._read(name), value):
                    self._write(name, value)
                del self.before[name]
            except HardwareError as error:
                problem = problem or error
        if problem is not None:
            raise problem
