"""What the store raises when the fault is not the caller's input but the disk's or the database's."""


class StoreUnavailable(RuntimeError):
    """The database cannot take or give anything now: a full or read-only disk, a lost connection. One sentence."""


class StoreBusy(RuntimeError):
    """So much waits to be committed that no more is taken. One sentence."""
