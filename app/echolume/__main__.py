"""``python -m echolume`` is the ``echolume`` program."""

import sys

from echolume.main import main

sys.exit(main())
