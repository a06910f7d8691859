"""The same as `lfrtorch simulate`."""

from lfrtorch.cli.simulate import launch

if __name__ == "__main__":
    launch()
