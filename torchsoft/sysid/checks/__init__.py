"""After a fit: is what it left noise, and do the data agree with what was taken for granted?"""
