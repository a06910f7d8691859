"""The same as `lfrtorch evaluate`."""

from lfrtorch.cli.evaluate import launch

if __name__ == "__main__":
    launch()
