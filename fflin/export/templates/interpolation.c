
/* Grid of the gains: joint, number of points and points of each axis. */
static const int axis_joint[$axis_count] = $axis_joint;
static const int axis_size[$axis_count] = $axis_size;
static const ${name}_real axis[$axis_count][$axis_room] = $axis_points;

/* Feed back with the gain at the measured joints, interpolated linearly; constant outside. */
static void feed_back_between(const ${name}_measured *measured,
                              const ${name}_real dx[${NAME}_STATES], ${name}_real u[${NAME}_INPUTS])
{
    int cell[$axis_count], a, i, corner;
    ${name}_real share[$axis_count];

    for (a = 0; a < $axis_count; a++) {
        const ${name}_real *grid = &axis[a][0];
        const int last = axis_size[a] - 1;
        ${name}_real value = measured->joints[axis_joint[a]];
        if (continuous[axis_joint[a]]) {
            (void)unwrap(&value, 0);
        }
        value = value < grid[0] ? grid[0] : (value > grid[last] ? grid[last] : value);
        cell[a] = 0;
        for (i = 1; i < last; i++) {
            if (value >= grid[i]) {
                cell[a] = i;
            }
        }
        share[a] = (value - grid[cell[a]]) / (grid[cell[a] + 1] - grid[cell[a]]);
    }
    for (corner = 0; corner < $corners; corner++) {
        int gain = 0;
        ${name}_real weight = 1;
        for (a = 0; a < $axis_count; a++) {
            const int upper = (corner >> a) & 1;
            gain = gain * axis_size[a] + cell[a] + upper;
            weight *= upper ? share[a] : 1 - share[a];
        }
        feed_back(gain, weight, dx, u);
    }
}
