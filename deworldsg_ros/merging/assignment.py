"""The one-to-one assignment with the greatest total score.

`scipy.optimize.linear_sum_assignment` gives the same, but takes a fourth of the start of graph_node
to import.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64, Int64


@kernel
def assign(scores: Float64) -> Int64:
    """Column of each row, one to one, with the greatest total score; -1 = none.

    Shortest augmenting paths in the order of scipy: D. F. Crouse, "On implementing 2D rectangular
    assignment algorithms", IEEE Transactions on Aerospace and Electronic Systems 52(4), 2016.

    Args:
        scores: (n, k) float64, finite. All rows have a column if n <= k, else all columns have one.
    """
    count, width = scores.shape
    turned = count > width
    costs = np.empty((min(count, width), max(count, width)), np.float64)
    for row in range(count):
        for column in range(width):
            if turned:
                costs[column, row] = -scores[row, column]
            else:
                costs[row, column] = -scores[row, column]
    columns = _columns_of_rows(costs)
    if not turned:
        return columns
    rows, columns = columns, np.empty(count, np.int64)
    for row in range(count):
        columns[row] = -1
    for column in range(width):
        columns[rows[column]] = column
    return columns


@kernel
def _columns_of_rows(costs: Float64) -> Int64:
    """The assignment of n <= k rows with the least total cost."""
    count, width = costs.shape
    row_prices, column_prices = np.zeros(count, np.float64), np.zeros(width, np.float64)
    column_of, row_of = np.empty(count, np.int64), np.empty(width, np.int64)
    for index in range(width):
        row_of[index] = -1
    paths, lengths = np.empty(width, np.int64), np.empty(width, np.float64)
    open_columns, closed = np.empty(width, np.int64), np.empty(width, np.bool_)
    for first in range(count):
        column_of[first] = -1
        for index in range(width):
            lengths[index], closed[index] = np.inf, False
            open_columns[index] = width - 1 - index
        row, length, end = first, 0.0, -1
        for left in range(width, 0, -1):
            nearest, shortest = 0, np.inf
            for index in range(left):
                column = open_columns[index]
                through = length + costs[row, column] - row_prices[row] - column_prices[column]
                if through < lengths[column]:
                    paths[column], lengths[column] = row, through
                found = lengths[column]
                if found < shortest or (found == shortest and row_of[column] == -1):
                    nearest, shortest = index, found
            length, column = shortest, open_columns[nearest]
            closed[column], open_columns[nearest] = True, open_columns[left - 1]
            if row_of[column] == -1:
                end = column
                break
            row = row_of[column]
        row_prices[first] += length
        for column in range(width):
            if closed[column]:
                if column != end:
                    row_prices[row_of[column]] += length - lengths[column]
                column_prices[column] -= length - lengths[column]
        while True:
            row = paths[end]
            row_of[end] = row
            column_of[row], end = end, column_of[row]
            if row == first:
                break
    return column_of
