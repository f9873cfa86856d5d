"""A transcript as a device: it answers what the device answered then, so that a field record becomes a test.

What the host says must come in the recorded order; bytes may be cut differently. The recorded pauses are not kept.
"""

from collections.abc import Sequence

from simulated_devices.transcripts import TranscriptEntry


class ReplayedDevice:
    """Give the entries of one line (`transcripts.read`). `unexpected` collects what the host says otherwise."""

    def __init__(self, entries: Sequence[TranscriptEntry]) -> None:
        # Consecutive chunks of one direction are one turn of the conversation.
        self._turns: list[tuple[str, bytes]] = []
        for entry in entries:
            if entry.direction == "#":
                continue
            if self._turns and self._turns[-1][0] == entry.direction == "<":
                self._turns[-1] = ("<", self._turns[-1][1] + entry.data)
            else:
                self._turns.append((entry.direction, entry.data))
        self._next = 0
        self._heard = b""
        self.unexpected: list[bytes] = []

    @property
    def finished(self) -> bool:
        """Whether everything that the host said then has been said again."""
        return self._next >= len(self._turns)

    def receive(self, data: bytes) -> list[bytes]:
        self._heard += data
        # What a unit sent by itself before anything was asked.
        replies = self._said()
        while self._heard:
            if self.finished:
                self.unexpected.append(self._heard)
                self._heard = b""
                break
            direction, expected = self._turns[self._next]
            if direction == ">" and self._heard.startswith(expected):
                self._heard = self._heard[len(expected) :]
                self._next += 1
                replies += self._said()
            elif direction == ">" and expected.startswith(self._heard):
                break
            else:
                self.unexpected.append(self._heard)
                self._heard = b""
        return replies

    def _said(self) -> list[bytes]:
        replies: list[bytes] = []
        while not self.finished and self._turns[self._next][0] == "<":
            replies.append(self._turns[self._next][1])
            self._next += 1
        return replies
