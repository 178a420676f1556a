"""Foreign formats, one file each: ``sniff(path, head)`` and ``read(path, *, convention)``."""
