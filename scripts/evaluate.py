"""The same as `lfrtorch evaluate`."""

from lfrtorch.cli.command import start

if __name__ == "__main__":
    start("evaluate")
