"""`python -m gradcal_jax`: the command `gradcal`."""

import sys

from gradcal_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
