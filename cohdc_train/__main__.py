"""`python -m cohdc_train` is `cohdc`."""

from cohdc_train.cli import main

raise SystemExit(main())
