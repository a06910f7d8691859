"""The same as `lfrtorch linear`."""

from lfrtorch.cli.command import start

if __name__ == "__main__":
    start("linear")
