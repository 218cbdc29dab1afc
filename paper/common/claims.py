"""Goes when no chapter needs it: ``paper.common.verdicts`` has all of it."""

from paper.common.verdicts import *  # noqa: F403
