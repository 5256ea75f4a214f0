"""`python -m kfgs` is the `kfgs` command."""

from .cli import main

raise SystemExit(main())
