"""What a registration's uncertainty leaves of the gain of its case's plan."""

from femoreg_torch.case import Case, Result
from femoreg_torch.planning.response import Quoted, Response, read_response


def response_of(case: Case) -> Response | None:
    """How the gain of the case's plan answers to errors.

    None where its path is not from a plan of `femoreg plan`, or `femoreg plan-offsets` was not run on that. Raises
    `InputError` for a plan that cannot be read.
    """
    return None if case.plan is None or case.plan.file is None else read_response(case.plan.file)


def quoted_gain(response: Response | None, result: Result) -> Quoted | None:
    """The gain under the covariance of the path in the result.

    None where there is no response, no tool was registered, or the result is not trusted: its covariance then says
    nothing.
    """
    if response is None or result.path_covariance is None or not result.verdict.trusted:
        return None
    return response.under(result.path_covariance.numpy())
