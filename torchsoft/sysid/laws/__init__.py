"""Which of several laws made the data?"""
