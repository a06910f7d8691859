"""Several processes that share one fit, see ``ranks``."""

from lfrtorch.distributed.ranks import (
    ProcessGroup,
    ProcessLostError,
    Ranks,
    agreed,
    connect,
    current,
    using,
)

__all__ = ["ProcessGroup", "ProcessLostError", "Ranks", "agreed", "connect", "current", "using"]
