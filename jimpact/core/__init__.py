"""The core: scenes, contact space, the base class of laws, an impact and its checks."""
