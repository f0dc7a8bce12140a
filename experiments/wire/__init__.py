"""The figures of drivers and emulators over the wire."""
