"""Where the gap lies, no library asked: followed.py the trajectory that the readings tell, forms.py and columns.py what
a discrepancy of each component may look like, sparse.py how few of these forms do, suspects.py the components in order.
"""
