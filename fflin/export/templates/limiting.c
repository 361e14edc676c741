    for (i = 0; i < ${NAME}_INPUTS; i++) {
        if (status == ${NAME}_INVALID) {
            u[i] = u0[$row][i];
        }
        if (u[i] < low[i] || u[i] > high[i]) {
            u[i] = u[i] < low[i] ? low[i] : high[i];
            status = status == ${NAME}_OK ? ${NAME}_LIMITED : status;
        }
    }
    return status;
