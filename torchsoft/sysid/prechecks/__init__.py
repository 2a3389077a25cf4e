"""Before a fit: can recordings be what they are taken for?"""
