"""Summary."""
def summary(model):
    return ""
