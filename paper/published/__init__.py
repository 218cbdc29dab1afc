"""Tables and records on which others have published numbers, and: never worse than the formula."""
