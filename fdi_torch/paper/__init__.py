"""The 2020 paper on one page: its tables and figures made again, ours and its numbers side by side."""
