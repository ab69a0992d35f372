"""Which dialect a box speaks, found by reading only. Pure.

=========================  ============  ============  =====================
read                       2.17          2.20          later
=========================  ============  ============  =====================
0xA0 x 9 (0x04)            state letter  state number  exception 2
0xA9 x 3 (0x03)            (no answer)   three words   (exception 2)
0x0000 x 12 (0x04)         (exception)   (exception)   twelve words
=========================  ============  ============  =====================

In brackets: not asked for. PROTOCOLS.md, 3.
"""

from ..errors import ImplausibleReplyError
from ..registers import Block
from .dialects import MAPS, PROBE_A0, PROBE_A9, Dialect
from .registers import ILLEGAL_ADDRESS, decode_status, dialect_of_a0


class Probe:
    """What was learnt so far; an answer half understood leads nowhere."""

    def __init__(self) -> None:
        """Begin with the block of the older dialects."""
        self.ask = PROBE_A0
        """The block to be read next."""
        self.found: Dialect | None = None
        """The dialect, as soon as it is certain."""

    def told(self, data: bytes) -> None:
        """Take an answer; raises ImplausibleReplyError for no SmartEVSE's."""
        if self.ask == PROBE_A0:
            dialect = dialect_of_a0(data)
            if dialect is None:
                raise _unknown(self.ask)
            if dialect is Dialect.V2_20:
                self.ask = PROBE_A9
            else:
                self.found = dialect
        elif self.ask == PROBE_A9:
            self.found = Dialect.V2_20
        else:
            decode_status(Dialect.LATER, data)
            self.found = Dialect.LATER

    def refused(self, code: int | None) -> None:
        """Take an exception; raises ImplausibleReplyError for no SmartEVSE's."""
        if self.ask != PROBE_A0 or code != ILLEGAL_ADDRESS:
            raise _unknown(self.ask)
        self.ask = MAPS[Dialect.LATER].status.block


def _unknown(block: Block) -> ImplausibleReplyError:
    message = f"no known SmartEVSE answers like this to {block.register:#06x}"
    return ImplausibleReplyError(message)
