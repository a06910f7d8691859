"""``python -m lfrtorch.cli NAME ...``, for torchrun."""

from lfrtorch.cli.command import main

if __name__ == "__main__":
    main()
