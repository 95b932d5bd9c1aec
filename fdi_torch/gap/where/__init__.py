"""Where the gap lies, without the library: forms.py and components.py say what a discrepancy of each component may look
like, survey.py what that does to the readings, sparse.py how few of the forms are needed, localization.py how likely
each place is.
"""
