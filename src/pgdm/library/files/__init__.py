"""The files the library reads and writes, none of which may run code."""
