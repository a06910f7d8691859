"""The same as `lfrtorch simulate`."""

from lfrtorch.cli.command import start

if __name__ == "__main__":
    start("simulate")
