"""The same as `lfrtorch preview`."""

from lfrtorch.cli.command import start

if __name__ == "__main__":
    start("preview")
