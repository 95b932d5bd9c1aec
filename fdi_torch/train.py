"""`python -m fdi_torch.train` is `fdi train`."""

import sys

from fdi_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
