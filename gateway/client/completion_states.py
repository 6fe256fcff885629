"""The states of a Completion."""

import enum


class CompletionState(enum.Enum):
    """What a Completion does with a message that arrives.

    =====================  ================================================================================
    BEGINNING → FOLLOWING  the first message has arrived
    BEGINNING → FILLING    the history has said where to begin
    FOLLOWING → FILLING    a number is missing, or the end has come
    FILLING → FOLLOWING    nothing is missing any more, or what is missing is given up
    any before → CHECKING  the numbers of what arrives, or an answer of the history, look like a restart
    CHECKING → FILLING     there was no restart (back to BEGINNING if the beginning is still not known)
    CHECKING → FOLLOWING   there was one, and the next run begins
    any before → PASSING   gaps cannot be filled now: see ``Completion.problem``
    PASSING → FOLLOWING    that is over
    any → ENDED            the subscriber is closed
    =====================  ================================================================================
    """

    BEGINNING = enum.auto()
    """The number to begin with is not known: the first message says it, or the history if that is asked."""
    FOLLOWING = enum.auto()
    """Nothing is missing: hand on the next number."""
    FILLING = enum.auto()
    """Some are missing, and requested: hold the later ones."""
    CHECKING = enum.auto()
    """The numbers look as if the gateway had restarted: hold what arrives until the history has said so."""
    PASSING = enum.auto()
    """Gaps are not filled: hand on each message when it arrives."""
    ENDED = enum.auto()
    """Take nothing more."""


class End(enum.Enum):
    """How far the end of a recording is. It can come in any state: a restart is checked then, too."""

    OPEN = enum.auto()
    """It has not come: take what arrives."""
    ENDING = enum.auto()
    """Nothing more is taken, and the history is to say which number is the last."""
    KNOWN = enum.auto()
    """The last number is known, or nobody can say it."""


class Unknown(enum.Enum):
    """Places where nobody knows whether messages are missing."""

    RESTART = "restart"
    """Between two runs of the gateway: what it published last, or while it was not heard, went with it."""
    TWO_GATEWAYS = "two gateways"
    BEGINNING = "beginning"
    """Before the first message of a key that came later than others: the history has not answered."""
    END = "end"
    """After the last message: the history has not answered."""
