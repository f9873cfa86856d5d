"""Settings of a device that a driver changes: their values before are kept, and restored at the end.

The values must outlive this process, too: `on_first_change` passes them to another process, whose driver can restore
settings that it has not changed itself.
"""

from collections.abc import Callable, Mapping

from .errors import HardwareError


class KeptSettings:
    """The settings of one device, by the driver's names, in the device's own spelling of the values.

    `read` asks the device, `write` returns only when the device shows the new value, and `same` compares two values.
    A device without changed settings has a `KeptSettings()`.
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
        """Change a setting, unless it has that value already."""
        assert self._write is not None
        if not self._same(self.note(name, value), value):
            self._write(name, value)

    def note(self, name: str, value: str) -> str:
        """Keep the value of a setting before another command changes it to `value`. Returns the value."""
        assert self._read is not None
        shown = self._read(name)
        if name not in self.before and not self._same(shown, value):
            self.before[name] = shown
            self.on_first_change(name, shown)
        return shown

    def keep(self, before: Mapping[str, str]) -> None:
        """Take over the values kept by another process."""
        self.before = {**before, **self.before}

    def put_back(self) -> None:
        """Restore every setting, the last change first. All are tried; raises the first problem."""
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
