"""The live view in a browser. `window` alone knows viser; all else is plain data and testable."""
