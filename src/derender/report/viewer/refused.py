"""An answer that is no: what the person at the page is told, and the HTTP status it goes with."""


class Refused(Exception):
    """A request that is not granted.

    Attributes:
        status: HTTP status, 4xx or 503.
        message: what is wrong and what to do, in one sentence.
    """

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status = status
        self.message = message
