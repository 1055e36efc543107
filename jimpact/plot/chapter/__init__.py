"""The figures of the source chapter, drawn anew: each a function without arguments.

>>> from jimpact.plot.chapter.figures import CAPTIONS
>>> CAPTIONS["6.4"]
'the 3-ball system'
"""
