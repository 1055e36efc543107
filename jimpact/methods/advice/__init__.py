"""The simplest law that a scene needs."""
