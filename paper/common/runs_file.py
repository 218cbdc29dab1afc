"""Goes when no chapter needs it: ``paper.common.runs`` has it."""

from paper.common.runs import RunsFile as RunsFile
