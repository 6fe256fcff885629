"""Finds the command that a reply from the server answers.

A reply has no number that identifies its command. The client therefore has at most one pending command,
and the matcher remembers earlier commands whose replies may still arrive. The rules:

- Only a packet of the right type answers a command: see ``_ACKNOWLEDGED_COMMANDS``; an error answers any
  command. An acknowledgement that precedes XML or a frame (field note 3) is ignored.
- A text that names a command, with its parameters or without, replies to that command, or it is a duplicate.
- A text that names none may be the late reply to the oldest command whose reply is outstanding, or it
  answers the pending command, and the server has ignored the earlier ones (field note 20). It counts as the
  late reply first. If no further reply comes soon, ``assume`` gives it to the pending command.
- After the client gives up on a command, its reply stays outstanding until a later command has been
  answered, because servers answer in order.
"""

import re
from collections import deque
from collections.abc import Sequence
from enum import Enum
from typing import Final

from gateway.rtc3d.commands import (
    Bye,
    Command,
    ControlRecording,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from gateway.rtc3d.packets import Packet, PacketType, decode_text
from gateway.rtc3d.parameters import SECTIONS
from gateway.rtc3d.parameters_xml import named_sections

_ACKNOWLEDGED_COMMANDS: Final = (Version, SetByteOrder, StreamFrames, StopStreaming, Bye, ControlRecording)
"""The commands that an acknowledgement answers. The others are answered by XML, and by a frame or No Data."""

_VERBS: Final = r"(version|setbyteorder|sendparameters|sendcurrentframe|streamframes|bye|recording)\b"
_ACKNOWLEDGED: Final = re.compile(rf"(?:ok\W*)?{_VERBS}")
"""The command at the start of an acknowledgement's text, as all known servers write it (field note 1)."""
_REFUSED: Final = re.compile(rf"\b{_VERBS}")
"""A command anywhere in the text of an error."""

_MAX_TEXT_BYTES: Final = 1000
"""How much of a reply's text is read. A server may send one of the size of the largest packet."""

_MAX_REMEMBERED: Final = 8
"""The maximum number of outstanding commands, and of answered commands, that are remembered."""


class Match(Enum):
    """Whether a reply answers the pending command."""

    YES = "yes"
    MAYBE = "maybe"  # or it is the late reply to an earlier command
    NO = "no"


class ReplyMatcher:
    """Finds the command that each reply on one connection answers."""

    def __init__(self) -> None:
        self.pending: Command | None = None
        """The command whose answer the client is waiting for."""
        self.possible: Packet | None = None
        """The newest reply that may answer the pending command (``Match.MAYBE``)."""
        self._outstanding: deque[Command] = deque(maxlen=_MAX_REMEMBERED)
        """Earlier commands whose replies may still arrive, oldest first."""
        self._answered: deque[Command] = deque(maxlen=_MAX_REMEMBERED)
        """The commands answered last. Another reply to one of them is a duplicate."""

    def give_up(self) -> None:
        """Stop waiting for the pending command. A late reply to it answers no command."""
        if self.pending is not None:
            self._outstanding.append(self.pending)
            self.pending = self.possible = None

    def match(self, packet: Packet) -> Match:
        """Return whether a packet of type 0, 1 or 2 answers the pending command."""
        candidates = self._candidates(packet)
        if not candidates:
            return Match.NO
        oldest = candidates[0]
        if oldest == self.pending:
            return Match.YES
        self._outstanding.remove(oldest)
        if self.pending not in candidates:
            return Match.NO
        self.possible = packet
        return Match.MAYBE

    def finish_by_reply(self) -> None:
        """End the pending command, which a text or XML has answered."""
        # Servers answer in order, so replies to earlier commands do not follow any more. But if an equal
        # command is outstanding, this may be the late reply to that one, and another reply may follow.
        if self.pending not in self._outstanding:
            self._answered.extend(self._outstanding)  # if a reply that names one follows, it is a duplicate
            self._outstanding.clear()
        self._finish()

    def finish_by_data(self) -> None:
        """End the pending command, which a frame or No Data has answered."""
        if isinstance(self.pending, StreamFrames):
            self._outstanding.append(self.pending)  # its acknowledgement may follow
        self._finish()

    def _finish(self) -> None:
        if self.pending is not None:
            self._answered.append(self.pending)
            self.pending = self.possible = None

    def _candidates(self, packet: Packet) -> Sequence[Command]:
        """Return the unanswered commands that a packet may answer, oldest first."""
        if packet.type == PacketType.XML:
            return self._candidates_for_xml(packet.body)
        text = decode_text(packet.body[:_MAX_TEXT_BYTES]).lower()
        unanswered = [*self._outstanding, *([] if self.pending is None else [self.pending])]
        echoed = [command for command in (*unanswered, *self._answered) if str(command).lower() in text]
        if echoed:
            # One command's text may be the beginning of another's, so the longest echo counts.
            named = max(echoed, key=lambda command: len(str(command)))
            unanswered = [command for command in unanswered if command == named]
        if packet.type == PacketType.ERROR:
            # The text may mention other commands as well ("Version must be sent first").
            refused = set(_REFUSED.findall(text))
            return [command for command in unanswered if _verb(command) in refused] or unanswered
        unanswered = [command for command in unanswered if isinstance(command, _ACKNOWLEDGED_COMMANDS)]
        acknowledged = _ACKNOWLEDGED.match(text)
        if acknowledged is None:
            return unanswered
        return [command for command in unanswered if _verb(command) == acknowledged[1]]

    def _candidates_for_xml(self, xml: bytes) -> Sequence[Command]:
        """Return the SendParameters that the XML answers, the pending or an outstanding one; [] for none."""
        pending = [self.pending] if isinstance(self.pending, SendParameters) else []
        outstanding = [
            command
            for command in self._outstanding
            if isinstance(command, SendParameters) and command not in pending
        ]
        if not outstanding:
            return pending  # with any sections: some servers always send all of them, some leave sections out
        sections = named_sections(xml)

        def similarity(command: SendParameters) -> int:
            # 2 if the sections are those requested, 1 if some are missing (field note 9), else 0.
            requested = frozenset(command.sections or SECTIONS)
            return 2 if sections == requested else int(sections < requested)

        return [max((*outstanding, *pending), key=similarity)]


def _verb(command: Command) -> str:
    return str(command).split()[0].lower()
