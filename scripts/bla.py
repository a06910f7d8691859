"""The same as `lfrtorch linear`."""

from lfrtorch.cli.linear import launch

if __name__ == "__main__":
    launch()
