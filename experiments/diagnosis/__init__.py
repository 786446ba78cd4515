"""What the networks of a trained run are like; see experiments/diagnose.py."""
