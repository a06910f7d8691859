"""Several processes that share one fit; see ``processes``."""

from lfrtorch.distributed.processes import (
    ProcessGroup,
    ProcessLostError,
    Ranks,
    agreed,
    connect,
    current,
    using,
)

__all__ = ["ProcessGroup", "ProcessLostError", "Ranks", "agreed", "connect", "current", "using"]
