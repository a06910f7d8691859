"""Errors of users as one line."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.errors import InstantiationException

from lfrtorch.cli.interrupts import Terminated
from lfrtorch.distributed import ProcessLost


@contextmanager
def user_errors(rank: str = "0") -> Iterator[None]:
    """User errors end the program with one message and exit code 1, no traceback.

    A message names the group of the configuration, which a function's argument belongs to:
    ``data: seed is -1``.
    """
    error = "error" if rank == "0" else f"error on rank {rank}"
    try:
        yield
        return
    except InstantiationException as failed:
        group = re.search(r"^full_key: (.+)$", str(failed), re.MULTILINE)
        where = f"{group[1]}: " if group and failed.__cause__ else ""
        print(f"{error}: {where}{failed.__cause__ or failed}", file=sys.stderr)
    except (ValueError, OSError, ProcessLost) as failed:
        print(f"{error}: {failed}", file=sys.stderr)
    except Terminated as end:
        if rank == "0":
            print(end, file=sys.stderr)
        sys.exit(128 + signal.SIGTERM)
    except KeyboardInterrupt as stop:
        print(f"interrupted {str(stop) or 'outside the fit'}: nothing to keep", file=sys.stderr)
        sys.exit(130)
    sys.exit(1)
