"""Reading and writing of files: atomic writes, parsers with limits, and clear errors."""
