"""Identify a model: `python train.py +bench=boucwen`, the same as `lfrtorch fit +bench=boucwen`."""

from lfrtorch.cli.command import start

if __name__ == "__main__":
    start("fit")
