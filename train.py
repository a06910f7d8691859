"""Identify a model: `python train.py +bench=boucwen`, the same as `lfrtorch fit +bench=boucwen`."""

from lfrtorch.cli.fit import launch

if __name__ == "__main__":
    launch()
