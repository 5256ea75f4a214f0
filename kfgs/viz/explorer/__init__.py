"""The explorer: both clouds side by side, asked in words, in a window, a browser or a notebook."""
