/* One robot's turn in many joint plans (planners/beam.py is the reference): the values of all its
 * moves, and, once the best have been chosen, the plans that they lead to.
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share of problems.
 * The same operations on floats in the same order as the reference: values agree to the last bit.
 */
#include "grid.h"

#include <math.h>
#include <stdlib.h>

enum { STAY = DIRECTIONS, MOVES = DIRECTIONS + 1 };

/* One turn: K plans of each of M problems for N robots, on grids of C cells of which windows have
 * S; bools are a byte each, 0 or 1. */
typedef struct {
    const int64_t *cell;     /* [M, K, N] */
    const int64_t *before;   /* [M, K, N] */
    const int16_t *unknown;  /* [M, K, C] */
    const int64_t *code;     /* [M, K] */
    const float *seen;       /* [M, K] */
    const uint8_t *occupied; /* [M, C] */
    const int64_t *target;   /* [M, U] */
    const float *share;      /* [M] */
    const int16_t *distance; /* [M, C, U] */
    const uint8_t *visible;  /* [M, N, C, S], or NULL */
    const int64_t *near;     /* [C, MOVES] */
    const uint8_t *inside;   /* [C, MOVES] */
    const int64_t *window;   /* [C, S] */
    const uint8_t *on_grid;  /* [C, S] */
    const int64_t *place;    /* [C] */
    const int64_t *hashes;   /* [1 + 2 N, C] */
    float *value;            /* [M, K MOVES] */
    float *new_seen;         /* [M, K MOVES] */
    int64_t *new_code;       /* [M, K MOVES] */
    const int64_t *first;    /* [M, K, N] */
    const int64_t *best;     /* [M, kept], moves of all plans */
    const float *best_value; /* [M, kept] */
    int64_t *to_cell, *to_before, *to_first; /* [M, kept, N] */
    int16_t *to_unknown;     /* [M, kept, C] */
    int64_t *to_code;        /* [M, kept] */
    float *to_seen;          /* [M, kept] */
    int64_t plans, robots, cells, targets, side2, robot, kept, is_first;
    float weight, of_distance, favour, of_order; /* floats of the reference's factors */
} Turn;

/* A plan of a problem. */
typedef struct {
    const int64_t *cell, *before, *near;
    const int16_t *unknown;
    int64_t problem, own;
} Plan;

static int64_t buckets_of(int64_t moves) {
    int64_t buckets = 1;
    while (buckets <= 16 * moves)
        buckets *= 2;
    return buckets;
}

/* Moves that are not dangerous, given obstacles and the plan's other moves. */
static void find_open(const Turn *turn, const Plan *plan, uint8_t *is_open) {
    const uint8_t *occupied = turn->occupied + plan->problem * turn->cells;
    const uint8_t *inside = turn->inside + plan->own * MOVES;
    const int64_t *place = turn->place;
    uint8_t wall[MOVES];
    for (int d = 0; d < MOVES; d++)
        wall[d] = occupied[plan->near[d]] | !inside[d];
    for (int d = 0; d < DIRECTIONS; d++) {
        const int left = d % 2 ? d - 1 : STAY, right = d % 2 ? (d + 1) % DIRECTIONS : STAY;
        is_open[d] = !(wall[d] | (wall[left] & wall[right]));
    }
    for (int64_t other = 0; other < turn->robots; other++) {
        const int64_t now = plan->cell[other], before = plan->before[other];
        const int64_t middle = place[now] + place[before] - place[plan->own];
        if (other == turn->robot)
            continue;
        for (int d = 0; d < DIRECTIONS; d++) {
            const int64_t to = plan->near[d];
            is_open[d] &= !((to == now) | (to == before) | (place[to] == middle));
        }
    }
    is_open[STAY] = 1;
}

/* Unknown cells that the robot would see from a cell, and the sum of their hashes. */
static int64_t count_new(const Turn *turn, const Plan *plan, int64_t to, int64_t *code) {
    const int64_t *window = turn->window + to * turn->side2;
    const uint8_t *on_grid = turn->on_grid + to * turn->side2;
    int64_t number = 0, sum = 0;
    if (turn->visible != NULL) {
        const int64_t of_robot = (plan->problem * turn->robots + turn->robot) * turn->cells + to;
        on_grid = turn->visible + of_robot * turn->side2;
        for (int64_t i = 0; i < turn->side2; i++)
            if (on_grid[i] && plan->unknown[window[i]]) {
                number++;
                sum += turn->hashes[window[i]];
            }
    } else {
        for (int64_t i = 0; i < turn->side2; i++) {
            const int64_t cell = on_grid[i] ? window[i] : plan->own; /* as in the reference */
            if (plan->unknown[cell]) {
                number++;
                sum += turn->hashes[cell];
            }
        }
    }
    *code = sum;
    return number;
}

/* Moves from each unknown cell to the nearest of the other robots. */
static void find_nearest(const Turn *turn, const Plan *plan, int16_t *restrict nearest) {
    const int64_t targets = turn->targets, *target = turn->target + plan->problem * targets;
    const int16_t *distance = turn->distance + plan->problem * turn->cells * targets;
    for (int64_t i = 0; i < targets; i++)
        nearest[i] = plan->unknown[target[i]];
    for (int64_t other = 0; other < turn->robots; other++) {
        const int16_t *restrict away = distance + plan->cell[other] * targets;
        if (other == turn->robot)
            continue;
        for (int64_t i = 0; i < targets; i++)
            nearest[i] = away[i] < nearest[i] ? away[i] : nearest[i];
    }
}

static int16_t sum_of_nearest(const Turn *turn, const int16_t *restrict nearest,
                              const int16_t *restrict away) {
    int16_t sum = 0; /* distances are so short that it fits */
    for (int64_t i = 0; i < turn->targets; i++)
        sum = (int16_t)(sum + (away[i] < nearest[i] ? away[i] : nearest[i]));
    return sum;
}

/* Hash of the other robots' cells, and of all before the step. */
static int64_t hash_places(const Turn *turn, const Plan *plan) {
    int64_t code = 0;
    for (int64_t other = 0; other < turn->robots; other++) {
        code += turn->hashes[(1 + other) * turn->cells + plan->before[other]];
        if (other != turn->robot)
            code += turn->hashes[(1 + turn->robots + other) * turn->cells + plan->cell[other]];
    }
    return code;
}

static void value_plan(const Turn *turn, int64_t problem, int64_t number, int16_t *nearest,
                       int64_t *hash) {
    const int64_t row = problem * turn->plans + number, robots = turn->robots;
    const int16_t *distance = turn->distance + problem * turn->cells * turn->targets;
    Plan plan = {.cell = turn->cell + row * robots,
                 .before = turn->before + row * robots,
                 .unknown = turn->unknown + row * turn->cells,
                 .problem = problem};
    plan.own = plan.cell[turn->robot];
    plan.near = turn->near + plan.own * MOVES;
    uint8_t is_open[MOVES];
    find_open(turn, &plan, is_open);
    find_nearest(turn, &plan, nearest);
    const int64_t others = hash_places(turn, &plan);
    const int64_t *own_hash = turn->hashes + (1 + robots + turn->robot) * turn->cells;
    for (int d = 0; d < MOVES; d++) {
        const int64_t to = plan.near[d], out = row * MOVES + d;
        int64_t code;
        const float new = (float)count_new(turn, &plan, to, &code);
        const float away = (float)sum_of_nearest(turn, nearest, distance + to * turn->targets);
        const float remote = away * turn->share[problem] - new;
        const float seen = turn->seen[row] + turn->weight * new;
        float value = seen - turn->of_distance * remote;
        if (d == STAY)
            value -= turn->favour;
        turn->value[out] = is_open[d] ? value : -INFINITY;
        turn->new_seen[out] = seen;
        turn->new_code[out] = turn->code[row] - code;
        hash[number * MOVES + d] = turn->new_code[out] + others + own_hash[to];
    }
}

/* Of equal plans only the best keeps its value; equal values are told apart by their order. */
static void keep_once(const Turn *turn, float *value, const int64_t *hash, float *best) {
    const int64_t moves = turn->plans * MOVES, mask = buckets_of(moves) - 1;
    for (int64_t i = 0; i < moves; i++) {
        value[i] -= (float)i * turn->of_order;
        best[hash[i] & mask] = -INFINITY;
    }
    for (int64_t i = 0; i < moves; i++)
        if (value[i] > best[hash[i] & mask])
            best[hash[i] & mask] = value[i];
    for (int64_t i = 0; i < moves; i++)
        if (value[i] < best[hash[i] & mask])
            value[i] = -INFINITY;
}

/* The cells that the robot sees from a cell are known. */
static void look(const Turn *turn, int64_t problem, int64_t to, int16_t *unknown) {
    const int64_t *window = turn->window + to * turn->side2;
    const uint8_t *on_grid = turn->on_grid + to * turn->side2;
    if (turn->visible != NULL) {
        const int64_t of_robot = (problem * turn->robots + turn->robot) * turn->cells + to;
        on_grid = turn->visible + of_robot * turn->side2;
    }
    for (int64_t i = 0; i < turn->side2; i++)
        if (on_grid[i])
            unknown[window[i]] = 0;
}

static void keep(const Turn *turn, int64_t problem, int64_t number) {
    const int64_t row = problem * turn->kept + number, robots = turn->robots;
    const int64_t best = turn->best[row], move = best % MOVES;
    const int64_t from = problem * turn->plans + best / MOVES, bytes = robots * sizeof(int64_t);
    const int64_t found = problem * turn->plans * MOVES + best;
    int64_t *cell = turn->to_cell + row * robots, *first = turn->to_first + row * robots;
    int16_t *unknown = turn->to_unknown + row * turn->cells;
    memcpy(cell, turn->cell + from * robots, bytes);
    memcpy(first, turn->first + from * robots, bytes);
    memcpy(turn->to_before + row * robots, turn->before + from * robots, bytes);
    memcpy(unknown, turn->unknown + from * turn->cells, turn->cells * sizeof *unknown);
    cell[turn->robot] = turn->near[cell[turn->robot] * MOVES + move];
    if (turn->is_first)
        first[turn->robot] = move;
    look(turn, problem, cell[turn->robot], unknown);
    turn->to_code[row] = turn->new_code[found];
    turn->to_seen[row] = turn->best_value[row] == -INFINITY ? -INFINITY : turn->new_seen[found];
}

/* The plans of problems `first` to `last` - 1 after their best moves. Returns 0. */
int marl_explore_beam_plans(const Turn *turn, int64_t first, int64_t last) {
    for (int64_t problem = first; problem < last; problem++)
        for (int64_t number = 0; number < turn->kept; number++)
            keep(turn, problem, number);
    return DONE;
}

/* The values of the moves of problems `first` to `last` - 1. Returns 0, or 1 when memory is out. */
int marl_explore_beam_values(const Turn *turn, int64_t first, int64_t last) {
    const int64_t moves = turn->plans * MOVES;
    int64_t *hash = malloc(moves * sizeof *hash + buckets_of(moves) * sizeof(float) +
                           turn->targets * sizeof(int16_t));
    if (hash == NULL)
        return NO_MEMORY;
    float *best = (float *)(hash + moves);
    int16_t *nearest = (int16_t *)(best + buckets_of(moves));
    for (int64_t problem = first; problem < last; problem++) {
        for (int64_t number = 0; number < turn->plans; number++)
            value_plan(turn, problem, number, nearest, hash);
        keep_once(turn, turn->value + problem * moves, hash, best);
    }
    free(hash);
    return DONE;
}
