"""The same as `lfrtorch preview`."""

from lfrtorch.cli.preview import launch

if __name__ == "__main__":
    launch()
