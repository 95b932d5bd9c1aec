"""Where the model and the rig part, which unmodelled effect it is, and how far the gap closes."""
