"""What the control experiments share: learners, resumable runs, records and summaries."""
