"""What all experiments share: how they are run, kept, judged, tabulated and drawn."""
