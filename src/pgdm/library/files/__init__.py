"""Reading and writing the library's files; reading never runs code from them."""
