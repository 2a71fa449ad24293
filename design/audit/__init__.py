"""python -m design.audit: are these gains safe, with what margin, and where does it bind?"""
