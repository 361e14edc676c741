    for (i = 0; i < ${NAME}_MEMORY && status != ${NAME}_INVALID; i++) {
        int j;
        next[i] = 0;
        for (j = 0; j < ${NAME}_MEMORY; j++) {
            next[i] += A[i][j] * memory->z[j];
        }
        for (j = 0; j < ${NAME}_STATES; j++) {
            next[i] += B[i][j] * x[j];
        }
    }
${windup_next}    for (i = 0; i < ${NAME}_MEMORY; i++) {
        if (!is_finite(next[i])) {
            status = ${NAME}_INVALID;
        }
    }
    for (i = 0; i < ${NAME}_MEMORY && status != ${NAME}_INVALID; i++) {
        memory->z[i] = next[i];
    }
