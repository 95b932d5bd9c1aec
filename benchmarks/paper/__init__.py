"""Reproduction of the tables and figures of the 2020 paper on one page, with published and computed numbers."""
